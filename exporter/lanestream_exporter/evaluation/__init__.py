"""Evaluation of models and baselines on labeled frames, at three levels that are never mixed.

A: the classifier on the proposed candidates, and proposal recall. B: boundaries per frame, the ego pair and all of
them, and their kinds, types and colors, from single images and, on clips, with the tracker. C: the metrics of the
TuSimple and CULane benchmarks. Pictures without a road are a group of their own. Every figure is defined in
docs/evaluation.md.
"""
