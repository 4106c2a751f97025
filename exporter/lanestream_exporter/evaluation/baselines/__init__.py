"""Baselines: two well-known classical pipelines, evaluated on the same frames for comparison.

They are not part of the product. Each implements the general idea of its kind at about the usual length. The settings
are the common ones that did best on the training split, scaled with the image. Both process every frame independently
and report only the boundaries of the ego lane.
"""

from lanestream_exporter.evaluation.baselines.hough_lines import HoughLinesBaseline
from lanestream_exporter.evaluation.baselines.sliding_window import SlidingWindowBaseline

__all__ = ["HoughLinesBaseline", "SlidingWindowBaseline"]
