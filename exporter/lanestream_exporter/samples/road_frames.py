"""Small frames for the regressor: images at its detail width, with boundaries and horizon."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from lanestream.detection.ego_prior import UNKNOWN_HORIZONS
from lanestream.errors import LabelError
from lanestream.images.resizing import resized, working_image
from lanestream.road.appearance import BoundaryKind
from lanestream.road.crops import RoadCropGeometry
from lanestream.road.curve import FloatArray
from lanestream.road.view import WORKING_WIDTH, Image, Scaling
from lanestream_exporter.datasets.horizons import shared_horizon
from lanestream_exporter.datasets.labels import WHOLE, LabeledFrame, LabeledImages, LabeledLane
from lanestream_exporter.samples.cache import FIRST_HARD_FILE, NO_ROAD, scene_files
from lanestream_exporter.samples.hard_scenes import Committee, Disagreement
from lanestream_exporter.scenes import render_still, sample_picture, sample_scene

# The regressor warps images of this width.
_DETAIL_WIDTH = RoadCropGeometry.detail_width
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 95)
_SIZES = ((448, 252), (448, 336), (448, 448), (640, 360))
_SHARES = (0.48, 0.32, 0.06, 0.14)


@dataclass(frozen=True)
class RoadFrame:
    """A frame that the regressor learns from: its image as JPEG bytes, and its boundaries in pixels of that image.

    `lanes` are polylines (N, 2) from the lowest row upwards, and `kinds` what they are, None if unknown; `horizon` is
    the row at which they meet. `exhaustive` says that an ego boundary without a label is absent. `group` names the
    drive or clip, and `dataset` its data set. If `has_road` is false, the picture shows no road and the horizon is only
    where a crop assumes it.
    """

    jpeg: bytes
    width: int
    height: int
    lanes: tuple[FloatArray, ...]
    kinds: tuple[BoundaryKind | None, ...]
    horizon: float
    exhaustive: bool
    group: str
    dataset: str
    has_road: bool = True

    def image(self) -> Image:
        """Returns the image, BGR (H, W, 3)."""
        return np.asarray(cv2.imdecode(np.frombuffer(self.jpeg, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)

    @classmethod
    def of(cls, frame: LabeledFrame, image: Image, expected_horizon: float | None = None) -> RoadFrame | None:
        """Returns a labeled frame made small; None if its labels don't determine a horizon and none is expected."""
        scaling = Scaling(min(1.0, _DETAIL_WIDTH / frame.width))
        usable = [lane for lane in frame.lanes if len(lane.points) >= 3]
        lanes = tuple(scaling.to_working(lane.points) for lane in usable)
        # As the regressor does in service: to the working width first.
        small = image if scaling.factor == 1.0 else resized(working_image(image)[0], _DETAIL_WIDTH / WORKING_WIDTH)
        height, width = small.shape[:2]
        if frame.horizon is not None:
            horizon: float | None = scaling.to_working(frame.horizon)
        else:
            expected = None if expected_horizon is None else scaling.to_working(expected_horizon)
            horizon = shared_horizon(lanes, height, expected)
        if horizon is None:
            return None
        jpeg = cv2.imencode(".jpg", small, _JPEG)[1].tobytes()
        kinds = tuple(lane.kind for lane in usable)
        return cls(jpeg, width, height, lanes, kinds, horizon, frame.coverage.ego, frame.group, frame.dataset)


def rendered_frames(
    folder: Path,
    scenes: Sequence[int],
    workers: int,
    done: Callable[[int], None],
    committee: Committee | None = None,
) -> list[Path]:
    """Returns files of rendered frames, the n-th of `scenes[n]` scenes and seeded by n; existing files are kept.

    With a `committee`, only the scenes are kept about which its detectors disagree. `done` is called with the number of
    scenes of each file when it is finished. Raises ModelError for a bad file of the committee.
    """
    if committee is None:
        return scene_files(folder, "frames", scenes, _render_file, workers, done)
    committee.load()  # reports a bad file here rather than in another process
    write = partial(_render_file, committee=committee)
    return scene_files(folder, f"hard-{committee.digest}-frames", scenes, write, workers, done)


def no_road_frames(folder: Path, pictures: Sequence[int], workers: int, done: Callable[[int], None]) -> list[Path]:
    """Returns files of pictures without a road, the n-th with `pictures[n]` and seeded by n; existing files are kept.

    `done` is called with the number of pictures of each file when it is finished.
    """
    return scene_files(folder, "no-road-frames", pictures, _write_no_road, workers, done)


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
            **{
                **record,
                "lanes": tuple(np.asarray(lane, dtype=float) for lane in record["lanes"]),
                "kinds": tuple(record["kinds"]),
            },
        )
        for end, size, record in zip(ends, sizes, records, strict=True)
    ]


def _record(frame: RoadFrame) -> dict[str, object]:
    return {
        "width": frame.width,
        "height": frame.height,
        "lanes": [np.round(lane, 3).tolist() for lane in frame.lanes],
        "kinds": frame.kinds,
        "horizon": frame.horizon,
        "exhaustive": frame.exhaustive,
        "group": frame.group,
        "dataset": frame.dataset,
        "has_road": frame.has_road,
    }


def _render_file(number: int, scenes: int, path: Path, committee: Committee | None = None) -> None:
    first, disagreement = (0, None) if committee is None else (FIRST_HARD_FILE, committee.load())
    write_frames(path, _rendered(first + number, scenes, disagreement))


def _rendered(number: int, scenes: int, disagreement: Disagreement | None) -> Iterator[RoadFrame]:
    for index in range(scenes):
        rng = np.random.default_rng([number, index, 2])
        width, height = _SIZES[rng.choice(len(_SIZES), p=_SHARES)]
        still = render_still(sample_scene(rng, width, height))
        if disagreement is not None and not disagreement.about(still.image):
            continue
        labels = replace(_without_far_lanes(still.labels), horizon=still.horizon)
        frame = RoadFrame.of(labels, still.image)
        if frame is not None:
            yield frame


def _write_no_road(number: int, pictures: int, path: Path) -> None:
    write_frames(path, _no_road(number, pictures))


def _no_road(number: int, pictures: int) -> Iterator[RoadFrame]:
    for index in range(pictures):
        rng = np.random.default_rng([number, index, 3])
        width, height = _SIZES[rng.choice(len(_SIZES), p=_SHARES)]
        labels = LabeledFrame(
            width, height, (), NO_ROAD, NO_ROAD, WHOLE, NO_ROAD, rng.choice(UNKNOWN_HORIZONS) * height
        )
        frame = RoadFrame.of(labels, sample_picture(rng, width, height))
        if frame is not None:
            yield replace(frame, has_road=False)


def _without_far_lanes(frame: LabeledFrame) -> LabeledFrame:
    """Returns the labels without boundaries beyond the neighboring lanes."""
    lanes: tuple[LabeledLane, ...] = tuple(
        lane for lane in frame.lanes if lane.position is None or abs(lane.position) <= 2
    )
    return replace(frame, lanes=lanes)
