"""Following boundaries from frame to frame."""

from lanestream.tracking.tracker import LaneTracker, TrackerSettings

__all__ = ["LaneTracker", "TrackerSettings"]
