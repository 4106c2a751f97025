"""Labels for the frames between two labelled ones of a clip: boundaries followed from both, kept where the two agree.

A labeller draws one frame in ten or forty, and the road between looks different enough to learn from. A boundary that
both labelled frames name is moved onto its paint frame by frame, forwards from the one and backwards from the other. A
follower that goes astray hardly goes where the other one comes from, so what both say is kept and nothing else. No
network has a say in it, and what none can see yet is labelled as well as what it can.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from lanestream.detection.commonroad import CommonRoad

from lanestream.detection.curve_fit import Refinement
from lanestream.errors import LabelError
from lanestream.road.curve import Curve, FloatArray
from lanestream.road.results import Candidate
from lanestream.road.view import Image, RoadView
from lanestream_exporter.datasets.horizons import drive_horizons
from lanestream_exporter.datasets.labels import PARTIAL, LabelledFrame, LabelledLane
from lanestream_exporter.datasets.pictures import Opener, Picture
from lanestream_exporter.datasets.polylines import fitted_curve
from lanestream_exporter.datasets.reading import survey

# Nearer to the horizon than this share of the depth nothing is followed.
_TOP_SHARE: Final = 0.06

# The shares of the depth at which a curve is told anew under another horizon.
_ANCHORS: Final = np.array([1.0, 0.45, 0.15])

# A label has this many points, and its followers are compared at as many rows.
_POINTS: Final = 18


@dataclass(frozen=True)
class Between:
    """Labels every `stride`-th frame between two labelled ones that are not more than `longest` frames apart.

    The followers of a boundary agree where they are `agreement` pixels of a 1280 pixel wide image apart on average,
    measured across them.
    """

    stride: int = 5
    longest: int = 60
    agreement: float = 6.0
    refinement: Refinement = Refinement(road=CommonRoad(nod=0.0))

    def frames(self, video: Path, labelled: Mapping[int, LabelledFrame]) -> Iterator[tuple[LabelledFrame, Image]]:
        """Labelled frames between those of `labelled`, by index in the video, with their BGR images (H, W, 3).

        Frames without a boundary that can be told are left out. Raises SourceError for a video that can't be read.
        """
        indices = sorted(labelled)
        horizons = drive_horizons([labelled[index] for index in indices])
        ends = [
            _End(index, labelled[index], horizon)
            for index, horizon in zip(indices, horizons, strict=True)
            if horizon is not None
        ]
        pairs = [(first, last) for first, last in pairwise(ends) if last.index - first.index <= self.longest]
        stretches = _stretches(video, [(first.index, last.index) for first, last in pairs])
        for (first, last), images in zip(pairs, stretches, strict=True):
            for index, frame, image in self._between(first, last, images):
                yield replace(frame, source=f"{video.name}#{index}"), image

    def _between(self, first: _End, last: _End, images: Sequence[Image]) -> Iterator[tuple[int, LabelledFrame, Image]]:
        """The labelled frames of a stretch with their indices; `images` are all of it, both ends too."""
        names = [name for name in first.lines if name in last.lines]
        if not names:
            return
        shares = np.linspace(0.0, 1.0, len(images))
        road = [_Moment.between(first, last, names, float(share)) for share in shares]
        there = self._followed([first.lines[name].curve for name in names], road, images)
        back = self._followed([last.lines[name].curve for name in names], road[::-1], images[::-1])[::-1]
        whole = first.whole and last.whole and len(first.lines) == len(last.lines) == len(names)
        for step in range(self.stride, len(images) - 1, self.stride):
            nearer = first if shares[step] <= 0.5 else last
            told = [
                self._label(nearer.lines[name].lane, pair, span, road[step])
                for name, *pair, span in zip(names, there[step], back[step], road[step].spans, strict=True)
            ]
            lanes = tuple(lane for lane in told if lane is not None)
            if lanes:
                coverage = nearer.frame.coverage if whole and len(lanes) == len(names) else PARTIAL
                yield first.index + step, replace(nearer.frame, lanes=lanes, coverage=coverage), images[step]

    def _followed(
        self, curves: Sequence[Curve], road: Sequence[_Moment], images: Sequence[Image]
    ) -> list[Sequence[Curve]]:
        """The `curves` of the first image in every one."""
        followed = [curves]
        for image, moment in zip(images[1:], road[1:], strict=True):
            candidates = [
                Candidate(_under(curve, moment.view), max(top, moment.view.row_at(_TOP_SHARE)), bottom, 1.0)
                for curve, (top, bottom) in zip(followed[-1], moment.spans, strict=True)
            ]
            fits, _ = self.refinement.refine(image, candidates, moment.view)
            followed.append([fit.curve for fit in fits])
        return followed

    def _label(
        self, lane: LabelledLane, pair: Sequence[Curve], span: tuple[float, float], moment: _Moment
    ) -> LabelledLane | None:
        """The mean of both followers, named as `lane`; None where they don't agree, or little of it is in view."""
        rows = np.linspace(*span[::-1], _POINTS)
        there, back = (curve.x(rows) for curve in pair)
        apart = np.abs(there - back) / np.hypot(1.0, pair[0].slope(rows))
        if apart.mean() > self.agreement * moment.view.width / 1280.0:
            return None
        points = np.stack([0.5 * (there + back), rows], axis=1)
        inside = points[(points[:, 0] >= 0.0) & (points[:, 0] <= moment.view.width - 1.0)]
        return replace(lane, points=inside) if len(inside) >= _POINTS // 3 else None


@dataclass(frozen=True)
class _Line:
    """A labelled boundary as the best curve under its frame's horizon, between the rows (top, bottom) of its `span`."""

    lane: LabelledLane
    curve: Curve
    span: tuple[float, float]


class _End:
    """A labelled frame at one end of a stretch: its boundaries by their names, those whose name is theirs alone.

    `whole` says that all labels of the frame are in them.
    """

    def __init__(self, index: int, frame: LabelledFrame, horizon: float) -> None:
        self.index, self.frame = index, frame
        self.view = RoadView(frame.width, frame.height, horizon)
        times = Counter(lane.lane_id for lane in frame.lanes)
        named = {lane.lane_id: lane for lane in frame.lanes if lane.lane_id is not None and times[lane.lane_id] == 1}
        lines = {name: self._line(lane) for name, lane in named.items()}
        self.lines = {name: line for name, line in lines.items() if line is not None}
        self.whole = len(self.lines) == len(frame.lanes)

    def _line(self, lane: LabelledLane) -> _Line | None:
        points = lane.points[lane.points[:, 1] > self.view.row_at(_TOP_SHARE)]
        if len(points) < 3:
            return None
        rows = points[:, 1]
        return _Line(lane, fitted_curve(points, self.view), (float(rows.min()), float(rows.max())))


@dataclass(frozen=True)
class _Moment:
    """A frame between two ends: about where its horizon is, and between which rows its boundaries can be seen."""

    view: RoadView
    spans: tuple[tuple[float, float], ...]

    @classmethod
    def between(cls, first: _End, last: _End, names: Sequence[int], share: float) -> _Moment:
        """The frame at `share` of the way from `first` to `last`."""
        horizon = _mixed(first.view.horizon, last.view.horizon, share)
        pairs = [(first.lines[name].span, last.lines[name].span) for name in names]
        spans = [(_mixed(a[0], b[0], share), _mixed(a[1], b[1], share)) for a, b in pairs]
        return cls(replace(first.view, horizon=horizon), tuple(spans))


def frames_between(path: Path, format: str, between: Between) -> Iterator[tuple[LabelledFrame, Image]]:  # noqa: A002
    """The frames between labelled ones of all videos of the data set at `path`, as `read_dataset` reads it.

    Raises LabelError and SourceError for what can't be read.
    """
    clips: dict[Path, dict[int, LabelledFrame]] = {}
    for sample in survey(path, format):
        if isinstance(sample, LabelError):
            raise sample
        picture = sample.entry.picture
        if picture.index is not None:
            clips.setdefault(picture.path, {})[picture.index] = sample.frame
    for video, labelled in clips.items():
        yield from between.frames(video, labelled)


def _mixed(first: float, last: float, share: float) -> float:
    return first + share * (last - first)


def _under(curve: Curve, view: RoadView) -> Curve:
    """The same curve, told under the horizon of `view`."""
    rows: FloatArray = view.horizon + _ANCHORS * view.depth
    return Curve.through(view.horizon, rows, curve.x(rows))


def _stretches(video: Path, stretches: Sequence[tuple[int, int]]) -> Iterator[list[Image]]:
    """The images of each of the `stretches` of a video, from its first index to its last, both included."""
    images: dict[int, Image] = {}
    with Opener() as opener:
        for first, last in stretches:
            # The end of one stretch is mostly the beginning of the next; a video is decoded forwards.
            images = {index: image for index, image in images.items() if index >= first}
            for index in range(first + len(images), last + 1):
                images[index] = opener.open(Picture(video, index))
            yield list(images.values())
