"""Lanestream: camera frames in, tracked lane lines out."""
