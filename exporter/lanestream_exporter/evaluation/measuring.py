"""Runs an evaluation: the same frames through every method, and all figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from lanestream.errors import LabelError
from lanestream_exporter.datasets.images import decoded_frames
from lanestream_exporter.datasets.labels import LabeledImages
from lanestream_exporter.datasets.manifest import DatasetCollection, LabeledClip
from lanestream_exporter.datasets.splits import Split
from lanestream_exporter.evaluation.boundaries import ReportedBoundary
from lanestream_exporter.evaluation.candidates import candidate_figures
from lanestream_exporter.evaluation.figures import boundary_figures, field_figures
from lanestream_exporter.evaluation.kinds import kind_figures
from lanestream_exporter.evaluation.lateral import lateral_figures
from lanestream_exporter.evaluation.methods import Method
from lanestream_exporter.evaluation.no_road import NoRoadOutcome, by_kind, no_road_figures, run_no_road
from lanestream_exporter.evaluation.outcomes import FrameEvaluation
from lanestream_exporter.evaluation.reliability import reliability_figures
from lanestream_exporter.evaluation.steadiness import steadiness
from lanestream_exporter.evaluation.stills import StillOutcome, by_source, run_stills, still_figures
from lanestream_exporter.evaluation.towns import run_towns, town_figures
from lanestream_exporter.evaluation.verdicts import verdicts

SCHEMA = 3
OVERALL = "overall"


@dataclass(frozen=True)
class EvaluationSet:
    """What is evaluated on: single labeled images, read again at each call of `images`, and labeled clips."""

    name: str
    images: Callable[[], LabeledImages]
    clips: tuple[LabeledClip, ...] = ()

    def __post_init__(self) -> None:
        names = [clip.name for clip in self.clips]
        repeated = next((name for name in names if names.count(name) > 1), None)
        if repeated is not None:  # figures are kept by name
            raise LabelError(f"two clips are named {repeated!r}", "rename one of the videos and its labels")

    @classmethod
    def of_split(cls, datasets: DatasetCollection, split: Split) -> EvaluationSet:
        """Returns a split of the data sets of a manifest. Raises LabelError for a bad record."""
        return cls(split, lambda: datasets.frames(split), tuple(datasets.clips(split)))


@dataclass
class ClipRun:
    """One method's results on a clip: every frame in order, and the labeled frames with and without tracking."""

    reported: list[tuple[ReportedBoundary, ...]] = field(default_factory=list)
    tracked: list[FrameEvaluation] = field(default_factory=list)
    alone: list[FrameEvaluation] = field(default_factory=list)
    size: tuple[int, int] = (1, 1)

    def figures(self) -> dict[str, Any]:
        """Returns the level B figures and those of kinds, with and without tracking, and the steadiness."""
        return {
            **_clip_groups(self.tracked, self.alone),
            "steadiness": steadiness(self.reported, self.tracked, self.size),
        }


@dataclass
class Evaluation:
    """The outcomes of every method: by method on images, pictures without a road, towns and stills, on clips by method
    and clip.
    """

    evaluation_set: EvaluationSet
    methods: tuple[Method, ...]
    images: dict[str, list[FrameEvaluation]]
    clips: dict[str, dict[str, ClipRun]]
    no_road: dict[str, list[NoRoadOutcome]]
    towns: dict[str, list[FrameEvaluation]] = field(default_factory=dict)
    stills: dict[str, list[StillOutcome]] = field(default_factory=dict)

    def figures(self) -> dict[str, Any]:
        """Returns all figures as written to the JSON file; docs/evaluation.md documents every key."""
        figures = {
            "schema": SCHEMA,
            "material": self.evaluation_set.name,
            "methods": {m.name: {"kind": m.kind, "regressor": m.regressor} for m in self.methods},
            "images": {method.name: self._image_figures(method) for method in self.methods},
            "datasets": {name: _part_figures(by_dataset(outcomes)) for name, outcomes in self.images.items()},
            "conditions": {name: _part_figures(by_condition(outcomes)) for name, outcomes in self.images.items()},
            "clips": {method.name: self._clip_figures(method) for method in self.methods},
            "no_road": {name: _no_road_figures(outcomes) for name, outcomes in self.no_road.items()},
            "towns": {name: town_figures(outcomes) if outcomes else {} for name, outcomes in self.towns.items()},
            "stills": {name: _still_figures(outcomes) for name, outcomes in self.stills.items()},
        }
        return {**figures, "verdicts": verdicts(figures)}

    def _image_figures(self, method: Method) -> dict[str, Any]:
        outcomes = self.images[method.name]
        return {drive: image_figures(method, part) for drive, part in by_drive(outcomes).items()}

    def _clip_figures(self, method: Method) -> dict[str, Any]:
        runs = self.clips[method.name]
        figures = {name: run.figures() for name, run in runs.items()}
        if not runs:
            return {}
        tracked = [outcome for run in runs.values() for outcome in run.tracked]
        alone = [outcome for run in runs.values() for outcome in run.alone]
        return {**figures, OVERALL: _clip_groups(tracked, alone)}


@dataclass(frozen=True)
class Extras:
    """How many random pictures without a road, rendered towns, and stills are evaluated besides the labeled frames."""

    no_road: int = 0
    towns: int = 0
    stills: int = 0


NO_EXTRAS: Final = Extras()
USUAL_EXTRAS: Final = Extras(no_road=200, towns=100, stills=100)


def image_figures(method: Method, outcomes: Sequence[FrameEvaluation]) -> dict[str, Any]:
    """Returns all figure groups of a method on single images. A new group is one more entry here."""
    figures: dict[str, Any] = {
        "boundaries": boundary_figures(outcomes),
        "kinds": kind_figures(outcomes),
        "reliability": reliability_figures(outcomes),
        "lateral": lateral_figures(outcomes),
        "field": field_figures(outcomes),
    }
    if method.threshold is not None:
        figures["candidates"] = candidate_figures(outcomes, method.threshold)
    return figures


def by_drive(outcomes: Sequence[FrameEvaluation]) -> dict[str, list[FrameEvaluation]]:
    """Returns the outcomes of each drive, and all of them together as `overall`."""
    drives: dict[str, list[FrameEvaluation]] = {}
    for outcome in outcomes:
        drives.setdefault(outcome.frame.group, []).append(outcome)
    return {**drives, OVERALL: list(outcomes)}


def by_dataset(outcomes: Sequence[FrameEvaluation]) -> dict[str, list[FrameEvaluation]]:
    """Returns the outcomes of each data set of a manifest; those of frames without a data set are left out."""
    parts: dict[str, list[FrameEvaluation]] = {}
    for outcome in outcomes:
        if outcome.frame.dataset:
            parts.setdefault(outcome.frame.dataset, []).append(outcome)
    return parts


def by_condition(outcomes: Sequence[FrameEvaluation]) -> dict[str, list[FrameEvaluation]]:
    """Returns the outcomes under each condition, by names like `light: dusk`, in alphabetical order."""
    parts: dict[str, list[FrameEvaluation]] = {}
    for outcome in outcomes:
        for name, value in outcome.frame.conditions.items():
            parts.setdefault(f"{name}: {value}", []).append(outcome)
    return dict(sorted(parts.items()))


def _part_figures(parts: Mapping[str, Sequence[FrameEvaluation]]) -> dict[str, Any]:
    return {name: {"boundaries": boundary_figures(part), "kinds": kind_figures(part)} for name, part in parts.items()}


def _no_road_figures(outcomes: Sequence[NoRoadOutcome]) -> dict[str, Any]:
    if not outcomes:
        return {}
    return {kind: no_road_figures(part) for kind, part in {**by_kind(outcomes), OVERALL: outcomes}.items()}


def _still_figures(outcomes: Sequence[StillOutcome]) -> dict[str, Any]:
    if not outcomes:
        return {}
    return {source: still_figures(part) for source, part in {**by_source(outcomes), OVERALL: outcomes}.items()}


def _clip_groups(tracked: Sequence[FrameEvaluation], alone: Sequence[FrameEvaluation]) -> dict[str, Any]:
    return {
        "tracked": boundary_figures(tracked),
        "alone": boundary_figures(alone),
        "kinds": {"tracked": kind_figures(tracked), "alone": kind_figures(alone)},
    }


def run_evaluation(
    methods: Sequence[Method],
    evaluation_set: EvaluationSet,
    report: Callable[[str], None] = lambda _: None,
    extras: Extras = NO_EXTRAS,
) -> Evaluation:
    """Runs every method on every frame of `evaluation_set`, and on the `extras`.

    `report` is called with the name of each stage.

    Raises LabelError and SourceError if the frames can't be read, and LabelError if none is labeled.
    """
    images: dict[str, list[FrameEvaluation]] = {method.name: [] for method in methods}
    report("single images")
    for frame, image in evaluation_set.images():
        for method in methods:
            images[method.name].append(method.detect(image, frame))
    clips: dict[str, dict[str, ClipRun]] = {method.name: {} for method in methods}
    for clip in evaluation_set.clips:
        report(clip.name)
        for name, run in _track(methods, clip).items():
            clips[name][clip.name] = run
    first = images[methods[0].name] if methods else []
    if methods and not first and not evaluation_set.clips:
        raise LabelError(f"{evaluation_set.name} has no labeled frames", "give labeled images")
    if extras.no_road:
        report("pictures without a road")
    no_road = run_no_road(methods, extras.no_road)
    if extras.towns:
        report("rendered towns")
    towns = run_towns(methods, extras.towns)
    stills: dict[str, list[StillOutcome]] = {}
    if extras.stills:
        report("stills")
        frames = [outcome.frame for outcome in first]
        stills = run_stills(methods, evaluation_set.images(), frames, extras.stills)
    return Evaluation(evaluation_set, tuple(methods), images, clips, no_road, towns, stills)


def _track(methods: Sequence[Method], clip: LabeledClip) -> dict[str, ClipRun]:
    runs = {method.name: ClipRun() for method in methods}
    trackers = {method.name: method.start_clip() for method in methods}
    for index, image, timestamp in decoded_frames(clip.video, clip.frames):
        for method in methods:
            run = runs[method.name]
            found = trackers[method.name](image, timestamp)
            run.reported.append(found)
            run.size = (image.shape[1], image.shape[0])
            if index in clip.labeled:
                run.tracked.append(FrameEvaluation(clip.labeled[index], found))
                run.alone.append(method.detect(image, clip.labeled[index]))
    return runs
