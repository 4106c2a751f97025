"""Measuring models and peers on labelled frames, at three levels that are never mixed.

A: the classifier on the candidates that were proposed, and what was proposed at all. B: boundaries per frame, the ego
pair and all of them, from single images and, on clips, with the tracker. C: the field's own metrics. What every figure
means is in docs/evaluation.md.
"""
