"""Peers: two well-known classical pipelines that run in the same evaluation, on the same frames, for scale.

They are no part of the product. Each is written from the general idea of its kind, in about the usual length and with
usual settings, scaled with the image; of those, the ones that did best on the training split. Both look at every frame
afresh and report the ego lane's boundaries alone.
"""

from lanestream_exporter.evaluation.baselines.hough_lines import HoughLinesPeer
from lanestream_exporter.evaluation.baselines.sliding_window import SlidingWindowPeer

__all__ = ["HoughLinesPeer", "SlidingWindowPeer"]
