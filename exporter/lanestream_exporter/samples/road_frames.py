"""Small frames for the regressor: images at its detail width, with boundaries and horizon."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from lanestream.errors import LabelError
from lanestream.images.resizing import resized, working_image
from lanestream.road.crops import RoadCropGeometry
from lanestream.road.curve import FloatArray
from lanestream.road.view import WORKING_WIDTH, Image, Scaling
from lanestream_exporter.datasets.horizons import shared_horizon
from lanestream_exporter.datasets.labels import LabeledFrame, LabeledImages, LabeledLane
from lanestream_exporter.samples.cache import scene_files
from lanestream_exporter.scenes import render_still, sample_scene

# The regressor warps images of this width.
_DETAIL_WIDTH = RoadCropGeometry.detail_width
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 95)
_SIZES = ((448, 252), (448, 336), (640, 360))
_SHARES = (0.5, 0.35, 0.15)


@dataclass(frozen=True)
class RoadFrame:
    """A frame that the regressor learns from: its image as JPEG bytes, and its boundaries in pixels of that image.

    `lanes` are polylines (N, 2) from the lowest row upwards; `horizon` is the row at which they meet. `exhaustive` says
    that an ego boundary without a label is absent. `group` names the drive or clip.
    """

    jpeg: bytes
    width: int
    height: int
    lanes: tuple[FloatArray, ...]
    horizon: float
    exhaustive: bool
    group: str

    def image(self) -> Image:
        """Returns the image, BGR (H, W, 3)."""
        return np.asarray(cv2.imdecode(np.frombuffer(self.jpeg, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)

    @classmethod
    def of(cls, frame: LabeledFrame, image: Image, expected_horizon: float | None = None) -> RoadFrame | None:
        """Returns a labeled frame made small; None if its labels don't determine a horizon and none is expected."""
        scaling = Scaling(min(1.0, _DETAIL_WIDTH / frame.width))
        lanes = tuple(scaling.to_working(lane.points) for lane in frame.lanes if len(lane.points) >= 3)
        # As the regressor does in service: to the working width first.
        small = image if scaling.factor == 1.0 else resized(working_image(image)[0], _DETAIL_WIDTH / WORKING_WIDTH)
        height, width = small.shape[:2]
        expected = None if expected_horizon is None else scaling.to_working(expected_horizon)
        horizon = shared_horizon(lanes, height, expected)
        if horizon is None:
            return None
        jpeg = cv2.imencode(".jpg", small, _JPEG)[1].tobytes()
        return cls(jpeg, width, height, lanes, horizon, frame.coverage.ego, frame.group)


def rendered_frames(folder: Path, scenes: Sequence[int], workers: int, done: Callable[[int], None]) -> list[Path]:
    """Returns files of rendered frames, the n-th with `scenes[n]` scenes and seeded by n; existing files are kept.

    `done` is called with the number of scenes of each file when it is finished.
    """
    return scene_files(folder, "frames", scenes, _render_file, workers, done)


def road_frames(labeled: LabeledImages) -> list[RoadFrame]:
    """Returns labeled frames made small. Frames with a single boundary get about their drive's horizon."""
    drives: dict[str, list[tuple[LabeledFrame, Image]]] = {}
    for frame, image in labeled:
        drives.setdefault(frame.group, []).append((frame, image))
    frames = []
    for drive in drives.values():
        first = [RoadFrame.of(frame, image) for frame, image in drive]
        horizons = [f.horizon / f.height for f in first if f is not None]
        median = float(np.median(horizons)) if horizons else None
        for frame, image in drive:
            small = RoadFrame.of(frame, image, None if median is None else median * frame.height)
            frames += [] if small is None else [small]
    return frames


def write_frames(path: Path, frames: Iterable[RoadFrame]) -> int:
    """Writes frames to `path` (.npz) atomically and returns their number."""
    kept = list(frames)
    data = np.frombuffer(b"".join(f.jpeg for f in kept), np.uint8)
    sizes = np.array([len(f.jpeg) for f in kept], dtype=np.int64)
    records = json.dumps([_record(f) for f in kept])
    unfinished = path.with_suffix(".part.npz")
    np.savez(unfinished, data=data, sizes=sizes, notes=np.frombuffer(records.encode(), np.uint8))
    unfinished.replace(path)
    return len(kept)


def read_frames(path: Path) -> list[RoadFrame]:
    """Returns the frames in a file of `write_frames`. Raises LabelError for any other file."""
    try:
        with np.load(path, allow_pickle=False) as file:
            data, sizes, records = file["data"], file["sizes"], json.loads(file["notes"].tobytes())
    except (OSError, ValueError, KeyError) as error:
        raise LabelError(f"{path} is not a file of frames", "delete it, and it is made again") from error
    ends = np.cumsum(sizes)
    return [
        RoadFrame(
            data[end - size : end].tobytes(),
            **{**record, "lanes": tuple(np.asarray(lane, dtype=float) for lane in record["lanes"])},
        )
        for end, size, record in zip(ends, sizes, records, strict=True)
    ]


def _record(frame: RoadFrame) -> dict[str, object]:
    return {
        "width": frame.width,
        "height": frame.height,
        "lanes": [np.round(lane, 3).tolist() for lane in frame.lanes],
        "horizon": frame.horizon,
        "exhaustive": frame.exhaustive,
        "group": frame.group,
    }


def _render_file(number: int, scenes: int, path: Path) -> None:
    write_frames(path, _rendered(number, scenes))


def _rendered(number: int, scenes: int) -> Iterator[RoadFrame]:
    for index in range(scenes):
        rng = np.random.default_rng([number, index, 2])
        width, height = _SIZES[rng.choice(len(_SIZES), p=_SHARES)]
        still = render_still(sample_scene(rng, width, height))
        frame = RoadFrame.of(_without_far_lanes(still.labels), still.image, still.horizon)
        if frame is not None:
            yield frame


def _without_far_lanes(frame: LabeledFrame) -> LabeledFrame:
    """Returns the labels without boundaries beyond the neighboring lanes."""
    lanes: tuple[LabeledLane, ...] = tuple(
        lane for lane in frame.lanes if lane.position is None or abs(lane.position) <= 2
    )
    return replace(frame, lanes=lanes)
