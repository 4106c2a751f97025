"""Figures of kinds, types and colors: what matched boundaries are reported to be, and markings where there are none.

They come from the matching of all boundaries. A label that does not say its kind, type or color is left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from lanestream.road.appearance import BOUNDARY_KINDS, MARKING_COLORS, MARKING_TYPES
from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.labels import LabeledLane
from lanestream_exporter.evaluation.bootstrap import intervals, point_estimates, ratio
from lanestream_exporter.evaluation.boundaries import FrameMatches, ReportedBoundary, match
from lanestream_exporter.evaluation.outcomes import FrameEvaluation

UNKNOWN: Final = "unknown"
NOTHING: Final = "nothing"


@dataclass(frozen=True)
class _Judged:
    """The outcome of a frame with its matching of all boundaries."""

    outcome: FrameEvaluation
    matches: FrameMatches

    @property
    def pairs(self) -> list[tuple[LabeledLane, ReportedBoundary]]:
        """The labels that were found, each with its report."""
        return [(found.label, self.outcome.reports[found.index]) for found in self.matches.matches]

    @property
    def wrong(self) -> list[ReportedBoundary]:
        """The reports that match no label, and can't be boundaries that the labels leave out."""
        return [self.outcome.reports[index] for index in self.matches.wrong_reports]


def kind_figures(outcomes: Sequence[FrameEvaluation]) -> dict[str, Any]:
    """Returns all figures of kinds, types and colors, and of false markings; see docs/evaluation.md."""
    frames = [_Judged(each, match(each.reports, each.frame.lanes, each.frame)) for each in outcomes]
    pairs = [pair for frame in frames for pair in frame.pairs]
    markings = [(label, report) for label, report in pairs if label.kind == report.kind == "marking"]
    return {
        "confusion": _confusion(frames),
        "types": _shares([(label.type, report.type) for label, report in markings], MARKING_TYPES),
        "colors": _shares([(label.color, report.color) for label, report in markings], MARKING_COLORS),
        "road_edges": _road_edges([frame for frame in frames if frame.outcome.frame.coverage.edges]),
        "false_markings": {
            "unmarked": _false_markings(each for each in outcomes if not each.frame.coverage.markings),
            "unpainted": _false_markings(each for each in outcomes if each.frame.conditions.get("markings") == "no"),
        },
    }


def _confusion(frames: Sequence[_Judged]) -> dict[str, dict[str, int]]:
    """Returns counts by the kind of the label, then by that of the report; `nothing` has no label or no report."""
    counts: dict[str, dict[str, int]] = {
        **{kind: dict.fromkeys((*BOUNDARY_KINDS, NOTHING), 0) for kind in BOUNDARY_KINDS},
        NOTHING: dict.fromkeys(BOUNDARY_KINDS, 0),
    }
    for frame in frames:
        for label, report in frame.pairs:
            if label.kind is not None:
                counts[label.kind][report.kind] += 1
        for label in frame.matches.missed_labels:
            if label.kind is not None:
                counts[label.kind][NOTHING] += 1
        for report in frame.wrong:
            counts[NOTHING][report.kind] += 1
    return counts


def _shares(pairs: Iterable[tuple[str | None, str | None]], classes: Sequence[str]) -> dict[str, Any]:
    """Returns the confusion of pairs of label and report, and the share of right ones.

    `constant_share` is what an answer would have right that is always the most frequent label.
    """
    counts = {label: dict.fromkeys((*classes, UNKNOWN), 0) for label in classes}
    for label, reported in pairs:
        if label in counts:
            counts[label][UNKNOWN if reported is None else reported] += 1
    totals = [sum(row.values()) for row in counts.values()]
    number, right = sum(totals), sum(row[label] for label, row in counts.items())
    return {
        "confusion": counts,
        "markings": number,
        "right": right,
        "right_share": round(right / number, 4) if number else None,
        "constant_share": round(max(totals) / number, 4) if number else None,
    }


def _road_edges(frames: Sequence[_Judged]) -> dict[str, Any]:
    """Returns the figures of reported edges in frames whose labels include the edges of the road.

    A reported edge is right if it matches a labeled one, and wrong if it matches a marking or nothing.
    """
    counts = np.array([_edge_counts(frame) for frame in frames], dtype=float).reshape(-1, 3)
    labeled, found, wrong = (int(n) for n in counts.sum(axis=0))
    labels = [frame.outcome.frame for frame in frames]
    return {
        "frames": len(frames),
        "labeled": labeled,
        "right": found,
        "wrong": wrong,
        **point_estimates(counts, labels, _edge_rates),
        "intervals": intervals(counts, labels, _edge_rates),
    }


def _edge_counts(frame: _Judged) -> tuple[int, int, int]:
    """Returns the numbers of labeled edges, and of right and wrong reports of edges."""
    labeled = sum(label.kind == "road_edge" for label in frame.outcome.frame.lanes)
    reported = [label.kind for label, report in frame.pairs if report.kind == "road_edge"]
    wrong = sum(report.kind == "road_edge" for report in frame.wrong) + reported.count("marking")
    return labeled, reported.count("road_edge"), wrong


def _edge_rates(counts: FloatArray) -> dict[str, FloatArray]:
    labeled, found, wrong = counts.T
    return {"precision": ratio(found, found + wrong), "recall": ratio(found, labeled)}


def _false_markings(outcomes: Iterable[FrameEvaluation]) -> dict[str, Any]:
    """Returns in how many frames without markings one is reported, wherever it lies."""
    chosen = list(outcomes)
    numbers = [sum(report.kind == "marking" for report in outcome.reports) for outcome in chosen]
    counts = np.array([(number > 0, 1) for number in numbers], dtype=float).reshape(-1, 2)
    frames = [outcome.frame for outcome in chosen]
    return {
        "frames": len(chosen),
        "with_marking": int(counts[:, 0].sum()),
        "markings": sum(numbers),
        **point_estimates(counts, frames, _share),
        "intervals": intervals(counts, frames, _share),
    }


def _share(counts: FloatArray) -> dict[str, FloatArray]:
    return {"share": ratio(counts[:, 0], counts[:, 1])}
