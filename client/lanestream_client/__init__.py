"""The Lanestream client: sends frames to a service and receives lane lines."""

from lanestream.protocol import CameraModel, DepartureOptions
from lanestream_client.async_client import AsyncLaneClient, AsyncLaneStream
from lanestream_client.client import LaneClient, LaneStream
from lanestream_client.frames import DetectedLanes, SourceFrame, StreamResult, StreamSummary
from lanestream_client.sources import LiveReader, open_source

__all__ = [
    "AsyncLaneClient",
    "AsyncLaneStream",
    "CameraModel",
    "DepartureOptions",
    "DetectedLanes",
    "LaneClient",
    "LaneStream",
    "LiveReader",
    "SourceFrame",
    "StreamResult",
    "StreamSummary",
    "open_source",
]
