"""The worst frames of an evaluation, with what was labelled and what was reported drawn on them."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from lanestream.road.curve import FloatArray
from lanestream.road.view import Image
from lanestream_exporter.evaluation.boundaries import match_ego
from lanestream_exporter.evaluation.figures import match_all
from lanestream_exporter.evaluation.measuring import EvaluationSet
from lanestream_exporter.evaluation.outcomes import Outcome

FRAMES = 24
_WIDTH = 480
_LABEL, _EGO, _OTHER = (80, 220, 80), (60, 60, 255), (255, 160, 40)  # blue, green, red


@dataclass(frozen=True)
class Exhibit:
    """One frame of the gallery: a JPEG as a data URL, and what went wrong in it."""

    caption: str
    picture: str = field(repr=False)


def gallery(evaluation_set: EvaluationSet, outcomes: Sequence[Outcome]) -> list[Exhibit]:
    """The worst frames, worst first. Reads the images again, so that an evaluation need not keep them."""
    worst = sorted(range(len(outcomes)), key=lambda i: _badness(outcomes[i]), reverse=True)[:FRAMES]
    wanted = {index: place for place, index in enumerate(worst)}
    exhibits: dict[int, Exhibit] = {}
    for index, (_, image) in enumerate(evaluation_set.images()):
        if index in wanted:
            exhibits[wanted[index]] = _exhibit(image, outcomes[index])
    return [exhibits[place] for place in sorted(exhibits)]


def _badness(outcome: Outcome) -> tuple[int, int, float]:
    """Ego boundaries missed or wrong, then all of them, then the mean error."""
    ego, every = match_ego(outcome.found, outcome.frame), match_all(outcome)
    error = float(np.mean([pair.error for pair in every.pairs])) if every.pairs else 0.0
    return ego.missed + ego.wrong, every.missed + every.wrong, error


def _exhibit(image: Image, outcome: Outcome) -> Exhibit:
    frame = outcome.frame
    scale = _WIDTH / frame.width
    size = _WIDTH, round(frame.height * scale)
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    for lane in frame.lanes:
        _draw(small, lane.points * scale, _LABEL, 2)
    for found in outcome.found:
        rows = np.linspace(found.top, found.bottom, 32)
        points = np.stack([found.curve.x(rows), rows], axis=1) * scale
        _draw(small, points, _EGO if found.position in (-1, 1) else _OTHER, 1)
    ego, every = match_ego(outcome.found, frame), match_all(outcome)
    caption = (
        f"{frame.group}, {frame.source}: ego {len(ego.pairs)} right, {ego.wrong} wrong, {ego.missed} missed; "
        f"all {len(every.pairs)} right, {every.wrong} wrong, {every.missed} missed"
    )
    encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
    return Exhibit(caption, "data:image/jpeg;base64," + base64.b64encode(encoded).decode())


def _draw(image: Image, points: FloatArray, color: tuple[int, int, int], thickness: int) -> None:
    path = np.round(np.clip(points, -1e4, 1e4)).astype(np.int32)
    cv2.polylines(image, [path], isClosed=False, color=color, thickness=thickness, lineType=cv2.LINE_AA)
