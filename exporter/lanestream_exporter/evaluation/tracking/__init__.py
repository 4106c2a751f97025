"""Measures tracking: the same frames through one or two systems, compared with exact truth or with labels.

`systems` runs a system, `comparison` puts its answers beside the truth, the modules of figures take the compared clips,
and `figures`, `tables` and `plots` assemble and show them. docs/evaluation.md documents every figure.
"""
