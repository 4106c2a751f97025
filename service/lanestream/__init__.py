"""Lanestream: camera frames in, tracked lane lines out."""

__version__ = "0.16.0"
