"""Label propagation: labels for the frames between two labeled frames of a clip.

A labeler draws one frame in ten or forty, and the road in between looks different enough to learn from. A boundary that
both labeled frames have is fitted to its paint frame by frame, forwards from the first and backwards from the last, and
kept where the two passes agree: a pass that drifts off rarely ends up where the other one started. No network is
involved, so boundaries that no network detects yet are labeled as well.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from lanestream.detection.curve_fit import FitSettings, fit_curves
from lanestream.detection.features import Channels
from lanestream.images.resizing import working_image
from lanestream.road.curve import Curve, Curves, FloatArray
from lanestream.road.view import Image, RoadView, Scaling, Spans
from lanestream_exporter.datasets.horizons import drive_horizons
from lanestream_exporter.datasets.images import ImageLocation, ImageReader
from lanestream_exporter.datasets.labels import PARTIAL, LabeledFrame, LabeledImages, LabeledLane, fitted_curve

# Boundaries are not fitted closer to the horizon than this share of the rows below it.
_TOP_SHARE: Final = 0.06

# The horizon is that between the two labeled frames: a drift of the boundaries must not move it.
_FIT: Final = FitSettings(move_horizon=False)

# Points of a propagated label; the two passes are compared at the same rows.
_POINTS: Final = 18


@dataclass(frozen=True)
class LabelPropagation:
    """Labels every `stride`-th frame between two labeled ones that are at most `longest` frames apart.

    The two passes agree on a boundary if their mean distance, measured across it, is at most `agreement` pixels of a
    1280 pixel wide image.
    """

    stride: int = 5
    longest: int = 60
    agreement: float = 6.0

    def frames(self, video: Path, labeled: Mapping[int, LabeledFrame]) -> LabeledImages:
        """Yields labeled frames between those of `labeled` (by index in the video) with their BGR images (H, W, 3).

        Both are at the working width, at which boundaries are fitted. Frames on which no boundary can be labeled are
        left out. Raises SourceError if the video can't be read.
        """
        indices = sorted(labeled)
        horizons = drive_horizons([labeled[index] for index in indices])
        keys = [
            _KeyFrame(index, labeled[index], horizon)
            for index, horizon in zip(indices, horizons, strict=True)
            if horizon is not None
        ]
        pairs = [(first, last) for first, last in pairwise(keys) if last.index - first.index <= self.longest]
        stretches = _read_stretches(video, [(first.index, last.index) for first, last in pairs])
        for (first, last), images in zip(pairs, stretches, strict=True):
            for index, frame, image in self._propagate(first, last, images):
                yield replace(frame, source=f"{video.name}#{index}"), image

    def _propagate(
        self, first: _KeyFrame, last: _KeyFrame, images: Sequence[Image]
    ) -> Iterator[tuple[int, LabeledFrame, Image]]:
        """Yields the labeled frames of a stretch with their indices; `images` include both key frames."""
        ids = [lane_id for lane_id in first.boundaries if lane_id in last.boundaries]
        if not ids:
            return
        shares = np.linspace(0.0, 1.0, len(images))
        steps = [_Step.interpolate(first, last, ids, float(share)) for share in shares]
        forward = _fit_pass(first.curves(ids), steps, images)
        backward = _fit_pass(last.curves(ids), steps[::-1], images[::-1])[::-1]
        complete = first.complete and last.complete and len(first.boundaries) == len(last.boundaries) == len(ids)
        for number in range(self.stride, len(images) - 1, self.stride):
            nearer = first if shares[number] <= 0.5 else last
            passes = zip(ids, forward[number], backward[number], strict=True)
            labels = [
                self._label(nearer.boundaries[lane_id].lane, (one, other), steps[number], index)
                for index, (lane_id, one, other) in enumerate(passes)
            ]
            lanes = tuple(lane for lane in labels if lane is not None)
            if lanes:
                coverage = nearer.frame.coverage if complete and len(lanes) == len(ids) else PARTIAL
                yield first.index + number, replace(nearer.frame, lanes=lanes, coverage=coverage), images[number]

    def _label(self, lane: LabeledLane, passes: tuple[Curve, Curve], step: _Step, index: int) -> LabeledLane | None:
        """Returns the mean of both passes as a label like `lane`; None if they disagree or little of it is visible."""
        rows = np.linspace(step.spans.bottom[index], step.spans.top[index], _POINTS)
        forward, backward = (curve.x(rows) for curve in passes)
        distance = np.abs(forward - backward) / np.hypot(1.0, passes[0].slope(rows))
        if distance.mean() > self.agreement * step.view.width / 1280.0:
            return None
        points = np.stack([0.5 * (forward + backward), rows], axis=1)
        inside = points[(points[:, 0] >= 0.0) & (points[:, 0] <= step.view.width - 1.0)]
        return replace(lane, points=inside) if len(inside) >= _POINTS // 3 else None


def _fit_pass(curves: Curves, steps: Sequence[_Step], images: Sequence[Image]) -> list[Curves]:
    """Returns the `curves` of the first image in every image, each fitted from the previous image's."""
    fitted = [curves]
    for image, step in zip(images[1:], steps[1:], strict=True):
        view = step.view
        spans = replace(step.spans, top=np.maximum(step.spans.top, view.row_at(_TOP_SHARE)))
        start = fitted[-1].below(view.horizon, view.bottom)
        fitted.append(fit_curves(Channels.of(image), start, spans, view, _FIT).curves)
    return fitted


@dataclass(frozen=True)
class _KeyBoundary:
    """A labeled boundary as the best curve under its frame's horizon, between the rows (top, bottom) of its label."""

    lane: LabeledLane
    curve: Curve
    rows: tuple[float, float]


class _KeyFrame:
    """A labeled frame at one end of a stretch: its markings by lane id, without ids that are not unique.

    All is in pixels of working images; the `horizon` that it is made with is in pixels of the frame. `complete` says
    that these are all labels of the frame.
    """

    def __init__(self, index: int, frame: LabeledFrame, horizon: float) -> None:
        horizon = Scaling.to_working_width(frame.width).to_working(horizon)
        self.index, self.frame = index, frame.at_working_width
        self.view = RoadView(self.frame.width, self.frame.height, horizon)
        # Edges of the road have no paint that could be followed.
        followed = [lane for lane in self.frame.lanes if lane.kind != "road_edge"]
        counts = Counter(lane.lane_id for lane in followed)
        unique = {lane.lane_id: lane for lane in followed if lane.lane_id is not None and counts[lane.lane_id] == 1}
        boundaries = {lane_id: self._boundary(lane) for lane_id, lane in unique.items()}
        self.boundaries = {lane_id: found for lane_id, found in boundaries.items() if found is not None}
        self.complete = len(self.boundaries) == len(frame.lanes)

    def curves(self, ids: Sequence[int]) -> Curves:
        """Returns the boundaries with these ids."""
        return Curves.of([self.boundaries[lane_id].curve for lane_id in ids])

    def _boundary(self, lane: LabeledLane) -> _KeyBoundary | None:
        points = lane.points[lane.points[:, 1] > self.view.row_at(_TOP_SHARE)]
        if len(points) < 3:
            return None
        rows = points[:, 1]
        return _KeyBoundary(lane, fitted_curve(points, self.view), (float(rows.min()), float(rows.max())))


@dataclass(frozen=True)
class _Step:
    """A frame between two key frames: its approximate horizon, and the rows of each boundary there."""

    view: RoadView
    spans: Spans

    @classmethod
    def interpolate(cls, first: _KeyFrame, last: _KeyFrame, ids: Sequence[int], share: float) -> _Step:
        """Returns the frame at `share` (0 to 1) of the way from `first` to `last`."""
        rows: FloatArray = np.array([[key.boundaries[lane_id].rows for lane_id in ids] for key in (first, last)])
        top, bottom = (rows[0] + share * (rows[1] - rows[0])).T
        horizon = first.view.horizon + share * (last.view.horizon - first.view.horizon)
        return cls(first.view.with_horizon(horizon), Spans(top, bottom, np.ones(len(ids), bool)))


def _read_stretches(video: Path, stretches: Sequence[tuple[int, int]]) -> Iterator[list[Image]]:
    """Yields the working images of each stretch (first index, last index) of a video, both included."""
    images: dict[int, Image] = {}
    with ImageReader() as reader:
        for first, last in stretches:
            # The end of one stretch is usually the start of the next, and a video is decoded forwards.
            images = {index: image for index, image in images.items() if index >= first}
            for index in range(first + len(images), last + 1):
                images[index] = working_image(reader.open(ImageLocation(video, index)))[0]
            yield list(images.values())
