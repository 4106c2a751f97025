"""Labeled frames: readers of every label format, the data set manifest, splits, checks and label propagation."""
