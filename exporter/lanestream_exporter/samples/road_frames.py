"""Frames for the regressor, kept small: pictures at the width that it looks at, boundaries and horizon beside them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from lanestream.detection.features import resized
from lanestream.detection.regression_detector import RegressionDetector
from lanestream.errors import LabelError
from lanestream.road.curve import FloatArray
from lanestream.road.view import Image, Scaling
from lanestream_exporter.datasets.horizons import shared_horizon
from lanestream_exporter.datasets.labels import LabelledFrame, LabelledLane
from lanestream_exporter.samples.cache import scene_files
from lanestream_exporter.scenes import render_still, sample_scene

_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 95)
_SIZES = ((448, 252), (448, 336), (640, 360))
_SHARES = (0.5, 0.35, 0.15)


@dataclass(frozen=True)
class RoadFrame:
    """A frame as the regressor learns from it: its picture as JPEG bytes, and in pixels of that picture its boundaries.

    `lanes` are polylines (N, 2) from the lowest row upwards; `horizon` is the row at which they meet. `exhaustive` says
    that an ego boundary without label is not there. `group` names the drive or clip.
    """

    jpeg: bytes
    width: int
    height: int
    lanes: tuple[FloatArray, ...]
    horizon: float
    exhaustive: bool
    group: str

    def image(self) -> Image:
        """The picture, BGR (H, W, 3)."""
        return np.asarray(cv2.imdecode(np.frombuffer(self.jpeg, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)

    @classmethod
    def of(cls, frame: LabelledFrame, image: Image, about: float | None = None) -> RoadFrame | None:
        """A labelled frame made small; None where its labels don't tell a horizon and `about` doesn't either."""
        scaling = Scaling(min(1.0, RegressionDetector.detail_width / frame.width))
        lanes = tuple(
            np.stack([(lane.points[:, i] + 0.5) * scaling.factor - 0.5 for i in (0, 1)], axis=1)
            for lane in frame.lanes
            if len(lane.points) >= 3
        )
        small = resized(image, scaling)
        height, width = small.shape[:2]
        expected = None if about is None else scaling.to_working(about)
        horizon = shared_horizon(lanes, height, expected)
        if horizon is None:
            return None
        jpeg = cv2.imencode(".jpg", small, _JPEG)[1].tobytes()
        return cls(jpeg, width, height, lanes, horizon, frame.coverage.ego, frame.group)


def rendered_frames(folder: Path, scenes: Sequence[int], workers: int, done: Callable[[int], None]) -> list[Path]:
    """A file of rendered frames for each number of `scenes`, the files seeded by their own number; kept where they are.

    `done` is told how many scenes have become ready.
    """
    return scene_files(folder, "frames", scenes, _render_file, workers, done)


def road_frames(labelled: Iterable[tuple[LabelledFrame, Image]]) -> list[RoadFrame]:
    """Labelled frames with their BGR images, made small; those with a single boundary have their drive's horizon."""
    drives: dict[str, list[tuple[LabelledFrame, Image]]] = {}
    for frame, image in labelled:
        drives.setdefault(frame.group, []).append((frame, image))
    frames = []
    for drive in drives.values():
        first = [RoadFrame.of(frame, image) for frame, image in drive]
        told = [f.horizon / f.height for f in first if f is not None]
        usual = float(np.median(told)) if told else None
        for frame, image in drive:
            small = RoadFrame.of(frame, image, None if usual is None else usual * frame.height)
            frames += [] if small is None else [small]
    return frames


def write_frames(path: Path, frames: Iterable[RoadFrame]) -> int:
    """Writes frames to `path` (.npz), whole or not at all; returns how many."""
    kept = list(frames)
    data = np.frombuffer(b"".join(f.jpeg for f in kept), np.uint8)
    sizes = np.array([len(f.jpeg) for f in kept], dtype=np.int64)
    notes = json.dumps([_note(f) for f in kept])
    unfinished = path.with_suffix(".part.npz")
    np.savez(unfinished, data=data, sizes=sizes, notes=np.frombuffer(notes.encode(), np.uint8))
    unfinished.replace(path)
    return len(kept)


def read_frames(path: Path) -> list[RoadFrame]:
    """The frames in a file of `write_frames`. Raises LabelError for a file that is none."""
    try:
        with np.load(path, allow_pickle=False) as file:
            data, sizes, notes = file["data"], file["sizes"], json.loads(file["notes"].tobytes())
    except (OSError, ValueError, KeyError) as error:
        raise LabelError(f"{path} is not a file of frames", "delete it to have it made again") from error
    ends = np.cumsum(sizes)
    return [
        RoadFrame(
            data[end - size : end].tobytes(),
            **{**note, "lanes": tuple(np.asarray(lane, dtype=float) for lane in note["lanes"])},
        )
        for end, size, note in zip(ends, sizes, notes, strict=True)
    ]


def _note(frame: RoadFrame) -> dict[str, object]:
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
        frame = RoadFrame.of(_near(still.labels), still.image, still.horizon)
        if frame is not None:
            yield frame


def _near(frame: LabelledFrame) -> LabelledFrame:
    """The labels without what lies beyond the next lanes: it bounds no lane that the camera could be in soon."""
    lanes: tuple[LabelledLane, ...] = tuple(
        lane for lane in frame.lanes if lane.position is None or abs(lane.position) <= 2
    )
    return replace(frame, lanes=lanes)
