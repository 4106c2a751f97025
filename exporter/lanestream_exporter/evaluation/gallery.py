"""The worst frames of a method, drawn with their labels and reports for the HTML report."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import cv2
import numpy as np

from lanestream.road.appearance import BoundaryKind
from lanestream.road.curve import FloatArray
from lanestream.road.view import Image
from lanestream_exporter.evaluation.boundaries import match_ego
from lanestream_exporter.evaluation.figures import match_all
from lanestream_exporter.evaluation.measuring import EvaluationSet
from lanestream_exporter.evaluation.outcomes import FrameEvaluation

GALLERY_FRAMES: Final = 24
_WIDTH: Final = 960
_DOT_SPACING: Final = 9.0  # pixels of the drawn image


@dataclass(frozen=True)
class _Style:
    """How a boundary is drawn: its color as blue, green and red, and its width in pixels; edges are dotted."""

    name: str
    bgr: tuple[int, int, int]
    thickness: int
    dotted: bool = False

    @property
    def css(self) -> str:
        """The color for the legend."""
        blue, green, red = self.bgr
        return f"#{red:02x}{green:02x}{blue:02x}"


_LABEL_MARKING: Final = _Style("labeled marking", (80, 220, 80), 6)
_LABEL_EDGE: Final = _Style("labeled road edge", (0, 215, 255), 6, dotted=True)
_LABEL_UNKNOWN: Final = _Style("labeled boundary of unknown kind", (200, 200, 200), 6)
_MARKING: Final = _Style("reported marking, thick if of the ego lane", (60, 60, 255), 2)
_EDGE: Final = _Style("reported road edge, thick if of the ego lane", (255, 120, 40), 2, dotted=True)
_OF_LABELS: Final[dict[BoundaryKind | None, _Style]] = {
    "marking": _LABEL_MARKING,
    "road_edge": _LABEL_EDGE,
    None: _LABEL_UNKNOWN,
}
_OF_REPORTS: Final[dict[BoundaryKind, _Style]] = {"marking": _MARKING, "road_edge": _EDGE}

STYLES: Final = (*_OF_LABELS.values(), *_OF_REPORTS.values())


@dataclass(frozen=True)
class GalleryImage:
    """One frame of the gallery: a JPEG as a data URL, and a caption with its mistakes."""

    caption: str
    url: str = field(repr=False)


def gallery(dataset: EvaluationSet, outcomes: Sequence[FrameEvaluation]) -> list[GalleryImage]:
    """Draws the worst frames, worst first. Reads the images again, so that the evaluation need not keep them."""
    worst = sorted(range(len(outcomes)), key=lambda i: _badness(outcomes[i]), reverse=True)[:GALLERY_FRAMES]
    rank_of = {index: rank for rank, index in enumerate(worst)}
    images: dict[int, GalleryImage] = {}
    for index, (_, image) in enumerate(dataset.images()):
        if index in rank_of:
            outcome = outcomes[index]
            encoded = cv2.imencode(".jpg", drawn(image, outcome), [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
            url = "data:image/jpeg;base64," + base64.b64encode(encoded).decode()
            images[rank_of[index]] = GalleryImage(_caption(outcome), url)
    return [images[rank] for rank in sorted(images)]


def drawn(image: Image, outcome: FrameEvaluation) -> Image:
    """Returns a BGR image (H, W, 3) at 960 columns with the labels and, above them, the reports of its frame."""
    scale = _WIDTH / outcome.frame.width
    size = _WIDTH, round(outcome.frame.height * scale)
    enlarged = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    for lane in outcome.frame.lanes:
        style = _OF_LABELS[lane.kind]
        _draw(enlarged, lane.points * scale, style, style.thickness)
    for report in outcome.reports:
        rows = np.linspace(report.top, report.bottom, 64)
        style = _OF_REPORTS[report.kind]
        is_ego = abs(report.position) == 1
        points = np.stack([report.curve.x(rows), rows], axis=1) * scale
        _draw(enlarged, points, style, style.thickness + 2 * is_ego)
    return enlarged


def _badness(outcome: FrameEvaluation) -> tuple[int, int, int, float]:
    """Returns a sort key: mistakes of the ego pair, false markings, mistakes of all boundaries, the mean error."""
    ego, every = match_ego(outcome.reports, outcome.frame), match_all(outcome)
    error = float(np.mean([match.error for match in every.matches])) if every.matches else 0.0
    return ego.missed + ego.wrong, _false_markings(outcome), every.missed + every.wrong, error


def _caption(outcome: FrameEvaluation) -> str:
    ego, every = match_ego(outcome.reports, outcome.frame), match_all(outcome)
    false = _false_markings(outcome)
    return (
        f"{outcome.frame.group}, {outcome.frame.source}: ego {len(ego.matches)} right, {ego.wrong} wrong, "
        f"{ego.missed} missed; all {len(every.matches)} right, {every.wrong} wrong, {every.missed} missed"
        + (f"; {false} markings reported on a road without any" if false else "")
    )


def _false_markings(outcome: FrameEvaluation) -> int:
    """Returns the number of reported markings in a frame without any."""
    return 0 if outcome.frame.coverage.markings else sum(report.kind == "marking" for report in outcome.reports)


def _draw(image: Image, points: FloatArray, style: _Style, thickness: int) -> None:
    path = np.clip(points, -1e4, 1e4)
    if not style.dotted:
        cv2.polylines(image, [np.round(path).astype(np.int32)], False, style.bgr, thickness, cv2.LINE_AA)
        return
    along = np.concatenate([[0.0], np.hypot(*np.diff(path, axis=0).T).cumsum()])
    places = np.arange(0.0, along[-1], _DOT_SPACING + thickness)
    for x, y in zip(np.interp(places, along, path[:, 0]), np.interp(places, along, path[:, 1]), strict=True):
        cv2.circle(image, (round(x), round(y)), max(2, thickness // 2 + 1), style.bgr, cv2.FILLED, cv2.LINE_AA)
