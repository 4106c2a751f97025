"""Converts lanes to the types of other libraries: supervision and Rerun, which are not dependencies of this package."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from lanestream.errors import MissingExtraError, needs_extra, needs_whole_packages
from lanestream_client.ego_lane import columns, ego_lane_outline
from lanestream_client.line_styles import line_style
from lanestream_client.pixels import check_pixels

with needs_extra("video"):
    import numpy as np

if TYPE_CHECKING:
    import rerun
    import supervision
    from numpy.typing import NDArray

    from lanestream.protocol import LaneModel, LanesMessage
    from lanestream_client.pixels import BgrImage

    FloatArray = NDArray[np.float64]

# Points along a boundary, and the edges between them as supervision wants them: it counts points from 1.
LANE_POINTS: Final = 24
LANE_EDGES: Final = tuple((number, number + 1) for number in range(1, LANE_POINTS))
_CLASSES: Final = ("marking", "road_edge")
# The part of the road that is logged in meters, ahead of the camera.
_AHEAD_M: Final = 60.0
_SAMPLES: Final = 48
# Half the widths of lines: in the image in pixels of the screen, on the road in meters.
_RADIUS_PX: Final = 2.0
_RADIUS_M: Final = 0.06
_JPEG_QUALITY: Final = 90


def to_supervision(message: LanesMessage) -> supervision.KeyPoints:
    """Returns the boundaries as `supervision.KeyPoints`, with LANE_POINTS points each, in pixels of the image.

    `EdgeAnnotator(edges=LANE_EDGES)` draws them as lines. Points go from the lowest row to the highest. The
    class is 0 for a marking and 1 for a road edge. `data` has an array of one value per boundary for each of
    `class_name`, `track_id`, `position`, `state` and `probability`, as the fields of `LaneModel` describe them.

    Raises MissingExtraError if supervision is not installed.
    """
    with _needs("supervision"):
        import supervision
    lanes = message.lanes
    points = np.array([_resampled(lane) for lane in lanes], np.float32).reshape(len(lanes), LANE_POINTS, 2)
    return supervision.KeyPoints(
        xy=points,
        class_id=np.array([_CLASSES.index(lane.kind) for lane in lanes], int),
        data={
            "class_name": np.array([lane.kind for lane in lanes], str),
            "track_id": np.array([lane.track_id for lane in lanes], int),
            "position": np.array([lane.position for lane in lanes], int),
            "state": np.array([lane.state for lane in lanes], str),
            "probability": np.array([lane.probability for lane in lanes], float),
        },
    )


def ego_lane_polygon(message: LanesMessage) -> NDArray[np.int64] | None:
    """Returns the ego lane as a polygon (N, 2) of x, y in whole pixels, or None unless both its boundaries are known.

    `supervision.PolygonZone(polygon)` finds the detections in it. It ends at the sides of the image.
    """
    outline = ego_lane_outline(message)
    if outline is None:
        return None
    return np.round(np.clip(outline, 0.0, (message.width - 1.0, message.height - 1.0))).astype(np.int64)


def log_to_rerun(
    message: LanesMessage,
    frame: BgrImage | None = None,
    *,
    entity: str = "camera",
    recording: rerun.RecordingStream | None = None,
) -> None:
    """Logs the lanes of one frame to Rerun, below `entity` of `recording`, or of the current recording if None.

    `ENTITY/image` is the frame, BGR (H, W, 3) uint8, as a JPEG, and `ENTITY/image/lanes` are lines in its pixels.
    `ENTITY/road/lanes` are lines in meters if the camera is known: x forward, y to the left, z up, with the origin on
    the road below the camera. The timelines are `frame`, the frame number, and `capture_time`, the timestamp in
    seconds. Labels, which the viewer shows on hover, have the track id, the position, the kind and the state.

    Raises ImageError if `frame` does not have the size of the image that was sent, and MissingExtraError if the Rerun
    SDK is not installed.
    """
    with _needs("rerun-sdk"):
        import rerun
    if frame is not None:
        check_pixels(frame, (message.width, message.height))
    rerun.set_time("frame", sequence=message.seq, recording=recording)
    rerun.set_time("capture_time", duration=message.timestamp, recording=recording)

    def log(path: str, archetype: Any) -> None:
        rerun.log(f"{entity}/{path}", archetype, recording=recording)

    if frame is not None:
        log("image", rerun.Image(frame, color_model="BGR").compress(jpeg_quality=_JPEG_QUALITY))
    # Without lanes, empty ones are logged: otherwise the viewer would go on showing those of an earlier frame.
    strips = [_resampled(lane) for lane in message.lanes]
    radius = rerun.Radius.ui_points(_RADIUS_PX)
    log("image/lanes", rerun.LineStrips2D(strips, radii=radius, **_style(message.lanes)))
    in_meters = [lane for lane in message.lanes if lane.ground is not None]
    if in_meters or message.departure is not None:
        rerun.log(f"{entity}/road", rerun.ViewCoordinates.FLU, static=True, recording=recording)
        strips = [_on_road(lane) for lane in in_meters]
        log("road/lanes", rerun.LineStrips3D(strips, radii=_RADIUS_M, **_style(in_meters)))


@contextmanager
def _needs(requirement: str) -> Iterator[None]:
    """Raises MissingExtraError, which says what to install, if an import in the block fails."""
    try:
        with needs_whole_packages():
            yield
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"this needs the package {error.name}, which is not installed", f"pip install {requirement}"
        ) from None


def _resampled(lane: LaneModel) -> FloatArray:
    """Returns points (LANE_POINTS, 2) along a boundary, from its lowest row to its highest."""
    rows = np.linspace(lane.line.bottom[1], lane.line.top[1], LANE_POINTS)
    return np.column_stack([columns(lane, rows), rows])


def _on_road(lane: LaneModel) -> FloatArray:
    """Returns points (N, 3) along a boundary on the flat road, in meters."""
    assert lane.ground is not None  # noqa: S101 - only lanes in meters are logged
    x = np.linspace(0.0, _AHEAD_M, _SAMPLES)
    return np.column_stack([x, np.polyval(lane.ground, x), np.zeros_like(x)])


def _style(lanes: Sequence[LaneModel]) -> dict[str, Any]:
    """Returns the colors of lines, and labels that do not cover the image."""
    return {
        "colors": [_rgba(lane) for lane in lanes],
        "labels": [_label(lane) for lane in lanes],
        "show_labels": False,
    }


def _label(lane: LaneModel) -> str:
    return f"{lane.track_id}: {lane.position:+d}, {lane.kind.replace('_', ' ')}, {lane.state}"


def _rgba(lane: LaneModel) -> tuple[int, int, int, int]:
    style = line_style(lane)
    blue, green, red = style.color
    return red, green, blue, round(255.0 * style.near_opacity)
