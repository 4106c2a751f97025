"""One evaluation: the same frames through every method, and all figures of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lanestream.errors import LabelError, SourceError
from lanestream.road.view import Image
from lanestream_exporter.datasets.clips import read_clip_labels
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.datasets.splits import LabelledClip, Split, labelled_clips, real_frames
from lanestream_exporter.evaluation.boundaries import ReportedBoundary
from lanestream_exporter.evaluation.candidates import candidate_figures
from lanestream_exporter.evaluation.figures import boundary_figures, field_figures
from lanestream_exporter.evaluation.lateral import lateral_figures
from lanestream_exporter.evaluation.methods import Method
from lanestream_exporter.evaluation.outcomes import FrameOutcome
from lanestream_exporter.evaluation.steadiness import steadiness

SCHEMA = 2
OVERALL = "overall"

Frames = Callable[[], Iterable[tuple[LabelledFrame, Image]]]


@dataclass(frozen=True)
class Material:
    """What is measured on: single labelled images, read anew at each call of `images`, and labelled clips."""

    name: str
    images: Frames
    clips: tuple[LabelledClip, ...] = ()

    @classmethod
    def of_split(cls, root: Path, split: Split) -> Material:
        """The project's own frames of a split, below the data folder `root`."""
        return cls(split, lambda: real_frames(root, split), tuple(labelled_clips(root, split)))


@dataclass
class ClipRun:
    """A clip as one method saw it: every frame of it in order, and its labelled frames with the memory and without."""

    reported: list[tuple[ReportedBoundary, ...]] = field(default_factory=list)
    tracked: list[FrameOutcome] = field(default_factory=list)
    alone: list[FrameOutcome] = field(default_factory=list)
    size: tuple[int, int] = (1, 1)

    def figures(self) -> dict[str, Any]:
        """Level B both ways, and steadiness."""
        return {
            "tracked": boundary_figures(self.tracked),
            "alone": boundary_figures(self.alone),
            "steadiness": steadiness(self.reported, self.tracked, self.size),
        }


@dataclass
class Evaluation:
    """The outcomes of every method: by method on images, by method and clip on clips."""

    material: Material
    methods: tuple[Method, ...]
    images: dict[str, list[FrameOutcome]]
    clips: dict[str, dict[str, ClipRun]]

    def figures(self) -> dict[str, Any]:
        """All figures, as written to the JSON file: every key is in docs/evaluation.md."""
        return {
            "schema": SCHEMA,
            "material": self.material.name,
            "methods": {m.name: {"kind": m.kind, "regressor": m.regressor} for m in self.methods},
            "images": {method.name: self._of_images(method) for method in self.methods},
            "clips": {method.name: self._of_clips(method) for method in self.methods},
        }

    def _of_images(self, method: Method) -> dict[str, Any]:
        outcomes = self.images[method.name]
        return {drive: image_figures(method, part) for drive, part in by_drive(outcomes).items()}

    def _of_clips(self, method: Method) -> dict[str, Any]:
        runs = self.clips[method.name]
        figures = {name: run.figures() for name, run in runs.items()}
        if not runs:
            return {}
        tracked = [outcome for run in runs.values() for outcome in run.tracked]
        alone = [outcome for run in runs.values() for outcome in run.alone]
        return {**figures, OVERALL: {"tracked": boundary_figures(tracked), "alone": boundary_figures(alone)}}


def image_figures(method: Method, outcomes: Sequence[FrameOutcome]) -> dict[str, Any]:
    """All figure groups of a method on single images. A further group is one more entry here."""
    figures: dict[str, Any] = {
        "boundaries": boundary_figures(outcomes),
        "lateral": lateral_figures(outcomes),
        "field": field_figures(outcomes),
    }
    if method.threshold is not None:
        figures["candidates"] = candidate_figures(outcomes, method.threshold)
    return figures


def by_drive(outcomes: Sequence[FrameOutcome]) -> dict[str, list[FrameOutcome]]:
    """The outcomes of each drive, and all of them together under `overall`."""
    drives: dict[str, list[FrameOutcome]] = {}
    for outcome in outcomes:
        drives.setdefault(outcome.frame.group, []).append(outcome)
    return {**drives, OVERALL: list(outcomes)}


def evaluate(methods: Sequence[Method], material: Material, tell: Callable[[str], None] = lambda _: None) -> Evaluation:
    """Every method on every frame of `material`; `tell` hears what is being done.

    Raises LabelError and SourceError for material that can't be read, or of which nothing is labelled.
    """
    images: dict[str, list[FrameOutcome]] = {method.name: [] for method in methods}
    tell("single images")
    for frame, image in material.images():
        for method in methods:
            images[method.name].append(method.detect(image, frame))
    clips: dict[str, dict[str, ClipRun]] = {method.name: {} for method in methods}
    for clip in material.clips:
        tell(clip.name)
        for name, run in _follow(methods, clip).items():
            clips[name][clip.name] = run
    if methods and not images[methods[0].name] and not material.clips:
        raise LabelError(f"nothing is labelled in {material.name}", "give labelled images")
    return Evaluation(material, tuple(methods), images, clips)


def _follow(methods: Sequence[Method], clip: LabelledClip) -> dict[str, ClipRun]:
    wanted = read_clip_labels(clip.labels, clip.coverage)
    runs = {method.name: ClipRun() for method in methods}
    followers = {method.name: method.start_clip() for method in methods}
    for index, image, timestamp in _decoded(clip.video, clip.frames):
        for method in methods:
            run = runs[method.name]
            found = followers[method.name](image, timestamp)
            run.reported.append(found)
            run.size = (image.shape[1], image.shape[0])
            if index in wanted:
                run.tracked.append(FrameOutcome(wanted[index], found))
                run.alone.append(method.detect(image, wanted[index]))
    return runs


def _decoded(video: Path, frames: range) -> Iterator[tuple[int, Image, float]]:
    """Frames of a clip with their index and their time in seconds."""
    capture = cv2.VideoCapture(str(video))
    if not capture.isOpened():
        raise SourceError(f"{video} can't be read as a video", "give the path of a video file")
    fps = capture.get(cv2.CAP_PROP_FPS) or 25.0
    capture.set(cv2.CAP_PROP_POS_FRAMES, frames.start)
    try:
        for index in frames:
            ok, image = capture.read()
            if not ok:
                return
            yield index, np.asarray(image, dtype=np.uint8), index / fps
    finally:
        capture.release()
