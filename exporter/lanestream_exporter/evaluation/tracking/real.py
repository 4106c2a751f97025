"""Runs systems over the labeled real clips, and the figures of those.

Labels are of key frames and need not be complete, so tracks that follow nothing can't be counted. Errors are measured
as in the other figures of clips: across the line, of boundaries that are right.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from lanestream.road.view import USUAL_LANE_WIDTH, Scaling
from lanestream_exporter.datasets.horizons import drive_horizons
from lanestream_exporter.datasets.images import decoded_frames
from lanestream_exporter.datasets.labels import LabeledFrame
from lanestream_exporter.datasets.manifest import DatasetCollection, LabeledClip
from lanestream_exporter.datasets.splits import SPLITS
from lanestream_exporter.evaluation.boundaries import (
    FrameMatches,
    ReportedBoundary,
    ego_labels,
    ego_sides,
    match,
    match_ego,
)
from lanestream_exporter.evaluation.tracking.answers import Answer
from lanestream_exporter.evaluation.tracking.appearance import appearance_figures
from lanestream_exporter.evaluation.tracking.comparison import (
    BOTTOM,
    FAR,
    GATE,
    ClipRun,
    rate,
    rounded,
)
from lanestream_exporter.evaluation.tracking.identity import id_switches
from lanestream_exporter.evaluation.tracking.motion import (
    LAG_ROWS,
    Stretch,
    jitter_figures,
    lag,
    second_differences,
)
from lanestream_exporter.evaluation.tracking.systems import PresentSystem, System, SystemSpec
from lanestream_exporter.evaluation.tracking.truth import TrueEgo, TruthFrame, TruthLane
from lanestream_exporter.evaluation.tracking.uncertainty import uncertainty_figures

# A clip that is not cut by frame numbers has no last frame in the manifest.
_WHOLE: Final = 1_000_000


@dataclass
class RealRun:
    """A system's run over a real clip.

    `matches` has, for each labeled frame, the ego labels that the tracker, a single image and, for this code, the
    detections of the session find.
    """

    clip: ClipRun
    matches: list[dict[str, FrameMatches]] = field(default_factory=list)


@dataclass(frozen=True)
class _Road:
    """What the labels of a clip say about its road: the horizon and bottom rows, and the lane's width per row."""

    horizon: float
    bottom: float
    lane_width: float

    @classmethod
    def of(cls, frames: Sequence[LabeledFrame]) -> _Road:
        horizons = [horizon for horizon in drive_horizons(frames) if horizon is not None]
        height = frames[0].height
        horizon = float(np.median(horizons)) if horizons else 0.5 * height
        lowest = [float(lane.points[:, 1].max()) for frame in frames for lane in frame.lanes if len(lane.points)]
        widths = [width for frame in frames if (width := _width_per_row(frame, horizon)) is not None]
        return cls(
            horizon,
            float(np.median(lowest)) if lowest else height - 1.0,
            float(np.median(widths)) if widths else USUAL_LANE_WIDTH,
        )

    def truth(self, index: int, timestamp: float, size: tuple[int, int], labels: LabeledFrame | None) -> TruthFrame:
        """Returns the labels of a frame as truth; a frame without labels has no lanes. Heights are 1 by definition."""
        sides = (None, None) if labels is None else ego_sides(labels)
        lanes = [
            TruthLane(
                side if lane.lane_id is None else lane.lane_id, side, lane.points, type=lane.type, color=lane.color
            )
            for side, lane in zip((-1, 1), sides, strict=True)
            if lane is not None
        ]
        return TruthFrame(
            index, timestamp, *size, 0, self.horizon, self.bottom, {"height": 1.0}, TrueEgo(lane_width=self.lane_width),
            tuple(lanes),
        )  # fmt: skip


def real_clips(datasets: DatasetCollection, held_out: bool) -> list[LabeledClip]:
    """Returns the labeled clips: whole ones of every split, and of a clip cut by time what is not held out.

    With `held_out` the part for tests of a clip that is cut by time is a clip of its own. Raises LabelError.
    """
    clips: dict[str, LabeledClip] = {}
    for split in SPLITS:
        for clip in datasets.clips(split):
            is_cut = clip.frames.stop < _WHOLE
            name = f"{clip.name} held out" if is_cut and split == "test" else clip.name
            if is_cut and split == "test" and not held_out:
                continue
            before = clips.get(name)
            labeled = clip.labeled if before is None else {**before.labeled, **clip.labeled}
            frames = clip.frames if before is None else _joined(before.frames, clip.frames)
            clips[name] = LabeledClip(name, clip.video, labeled, frames)
    return list(clips.values())


def run_real(
    specs: Sequence[SystemSpec], clips: Sequence[LabeledClip], report: Callable[[str], None] = lambda _: None
) -> dict[str, dict[str, dict[str, Any]]]:
    """Runs every system over every clip and returns the figures by system and clip.

    `report` is called with the name of each clip that ends. Raises SourceError if a video can't be read.
    """
    figures: dict[str, dict[str, dict[str, Any]]] = {spec.name: {} for spec in specs}
    with ExitStack() as stack:
        systems = {spec.name: stack.enter_context(closing(spec.start())) for spec in specs}
        for clip in clips:
            for name, run_figures in _run_clip(systems, clip).items():
                figures[name][clip.name] = run_figures
            report(clip.name)
    return figures


def _run_clip(systems: Mapping[str, System], clip: LabeledClip) -> dict[str, dict[str, Any]]:
    road = _Road.of(list(clip.labeled.values()))
    runs = {name: RealRun(ClipRun("real", clip.name)) for name in systems}
    streams = {name: system.open(None) for name, system in systems.items()}
    references: list[list[ReportedBoundary]] = []
    for index, image, timestamp in decoded_frames(clip.video, clip.frames):
        labels = clip.labeled.get(index)
        truth = road.truth(index, timestamp, (image.shape[1], image.shape[0]), labels)
        pending = {name: stream(image, timestamp) for name, stream in streams.items()}
        for name, wait in pending.items():
            system, answer = systems[name], Answer.from_message(wait())
            runs[name].clip.add(truth, answer)
            detected = _detected(system, truth.width)
            if isinstance(system, PresentSystem) and len(references) < len(runs[name].clip.frames):
                references.append(detected)
            if labels is not None:
                alone = Answer.from_message(system.open(None, single_image=True)(image, 0.0)())
                found = {"tracked": match_ego(_reports(answer), labels), "alone": match_ego(_reports(alone), labels)}
                if detected:
                    found["detections"] = match(detected, ego_labels(labels), labels)
                runs[name].matches.append(found)
    return {name: _figures(run, references) for name, run in runs.items()}


def _figures(run: RealRun, references: Sequence[Sequence[ReportedBoundary]]) -> dict[str, Any]:
    frames = run.clip.frames
    both = [{-1, 1} <= {lane.position for lane in frame.answer.lanes} for frame in frames]
    half = len(both) // 2
    return {
        "frames": len(frames),
        "labeled_frames": len(run.matches),
        "id_switches": sum(1 for _ in id_switches(run.clip)),
        "both_ego": _share(both),
        "both_ego_second_half": _share(both[half:]),
        "errors": _errors(run.matches),
        "appearance": appearance_figures([run.clip], after_s=0.0),
        "uncertainty": uncertainty_figures([run.clip]),
        "motion": {
            "jitter": jitter_figures(list(second_differences(run.clip))),
            "lag": {name: lag(_stretches(run.clip, references, row)) for name, row in LAG_ROWS.items()},
        },
    }


def _errors(matches: Sequence[Mapping[str, FrameMatches]]) -> dict[str, Any]:
    """Returns the mean errors of each way of finding boundaries, and of the tracker on the labels of detections."""
    figures: dict[str, Any] = {}
    for way in ("tracked", "alone", "detections"):
        errors = [boundary.error for found in matches if way in found for boundary in found[way].matches]
        figures[way] = {"boundaries": len(errors), "mean_px_640": rounded(float(np.mean(errors))) if errors else None}
    paired = [
        (boundary.error, other.error)
        for found in matches
        for boundary in found["tracked"].matches
        for other in (found["detections"].matches if "detections" in found else ())
        if boundary.label is other.label
    ]
    tracked, detected = np.array(paired).reshape(-1, 2).mean(axis=0) if paired else (None, None)
    return {
        **figures,
        "paired": {
            "boundaries": len(paired),
            "tracked_mean_px_640": rounded(tracked),
            "detections_mean_px_640": rounded(detected),
        },
    }


def _stretches(run: ClipRun, references: Sequence[Sequence[ReportedBoundary]], row: int) -> Iterator[Stretch]:
    """Yields the columns of ego tracks beside those of the nearest detection, while there is one, in each stretch."""
    current: dict[int, list[tuple[float, float]]] = {}
    for frame, detected in zip(run.frames, references, strict=False):
        continued: dict[int, list[tuple[float, float]]] = {}
        for index, lane in enumerate(frame.answer.lanes):
            columns = [float(boundary.curve.x(run.steady_rows[row])) for boundary in detected]
            if abs(lane.position) != 1 or not columns:
                continue
            x = float(frame.steady_x[index, row])
            nearest = min(columns, key=lambda column: abs(column - x))
            if abs(nearest - x) <= GATE * frame.lane_px[BOTTOM if row == 0 else FAR]:
                continued[lane.track_id] = current.pop(lane.track_id, [])
                continued[lane.track_id].append((x, nearest))
        yield from map(_arrays, current.values())
        current = continued
    yield from map(_arrays, current.values())


def _arrays(pairs: Sequence[tuple[float, float]]) -> Stretch:
    x, reference = np.array(pairs).T
    return x, reference


def _share(flags: Sequence[bool]) -> dict[str, Any]:
    return {"frames": len(flags), "both": sum(flags), "share": rate(sum(flags), len(flags))}


def _reports(answer: Answer) -> list[ReportedBoundary]:
    return [
        ReportedBoundary(
            lane.curve, lane.top, lane.bottom, lane.position, lane.track_id, None, lane.kind, lane.type, lane.color
        )
        for lane in answer.lanes
    ]


def _detected(system: System, width: int) -> list[ReportedBoundary]:
    """Returns the detections of the last frame in image pixels; none for a system that does not show them."""
    if not isinstance(system, PresentSystem) or system.detector.last is None:
        return []
    scaling = Scaling.to_working_width(width)
    return [
        ReportedBoundary(
            scaling.curve_to_image(found.curve),
            scaling.to_image(found.top),
            scaling.to_image(found.bottom),
            0,
            kind=found.appearance.kind,
        )
        for found in system.detector.last.boundaries
    ]


def _width_per_row(frame: LabeledFrame, horizon: float) -> float | None:
    """Returns the width of the ego lane over the rows below the horizon, where both boundaries are labeled."""
    lanes = ego_labels(frame)
    if len(lanes) != 2:
        return None
    row = min(float(lane.points[:, 1].max()) for lane in lanes)
    left, right = (float(TruthLane(0, 0, lane.points).columns(np.array([row]))[0]) for lane in lanes)
    return abs(right - left) / max(row - horizon, 1.0)


def _joined(one: range, other: range) -> range:
    return range(min(one.start, other.start), max(one.stop, other.stop))
