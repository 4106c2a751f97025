"""Figures of levels B and C: boundaries per frame, and the benchmarks' metrics, from the outcomes of frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.labels import LabeledFrame
from lanestream_exporter.evaluation.benchmarks import culane_frame, tusimple_frame
from lanestream_exporter.evaluation.bootstrap import intervals, point_estimates, ratio
from lanestream_exporter.evaluation.boundaries import FrameMatches, errors_along, match, match_ego
from lanestream_exporter.evaluation.outcomes import FrameEvaluation, ego_pair, markings_only

_DEPTH_BINS = 10  # bins of the error by depth


def boundary_figures(outcomes: Sequence[FrameEvaluation]) -> dict[str, Any]:
    """Returns the figures of level B, for the ego pair and all boundaries; see docs/evaluation.md."""
    ego = [match_ego(outcome.reports, outcome.frame) for outcome in outcomes]
    return {
        "ego": {"base_rate": _base_rate(ego), **_matched(outcomes, ego)},
        # What is not a boundary can't be counted among all boundaries.
        "all": {"base_rate": None, **_matched(outcomes, [match_all(outcome) for outcome in outcomes])},
    }


def match_all(outcome: FrameEvaluation) -> FrameMatches:
    """Matches all reported boundaries of a frame to all its labels."""
    return match(outcome.reports, outcome.frame.lanes, outcome.frame)


def field_figures(outcomes: Sequence[FrameEvaluation]) -> dict[str, Any]:
    """Returns the figures of level C, for all lanes and the ego pair; see docs/evaluation.md.

    The benchmarks know markings only, so edges of the road are left out.
    """
    whole = _with_markings(outcomes)
    pairs = _with_markings(map(ego_pair, outcomes))
    return {
        "tusimple": _tusimple(whole),
        "culane": _culane(whole),
        "ego": {"tusimple": _tusimple(pairs), "culane": _culane(pairs)},
    }


def _with_markings(outcomes: Iterable[FrameEvaluation]) -> list[FrameEvaluation]:
    """Returns the outcomes without edges of the road, of the frames that have a label then."""
    return [marked for outcome in outcomes if (marked := markings_only(outcome)).frame.lanes]


def _matched(outcomes: Sequence[FrameEvaluation], matched: Sequence[FrameMatches]) -> dict[str, Any]:
    rows = [(len(m.matches), m.wrong, m.missed, m.absent, sum(b.error for b in m.matches), 1) for m in matched]
    counts = np.array(rows, dtype=float).reshape(-1, 6)
    right, wrong, missed, absent = (int(n) for n in counts[:, :4].sum(axis=0))
    errors = [boundary.error for frame_matches in matched for boundary in frame_matches.matches]
    return {
        "frames": len(outcomes),
        "right": right,
        "wrong": wrong,
        "missed": missed,
        "absent": absent,
        **point_estimates(counts, _frames(outcomes), _boundary_rates),
        "median_error_px_640": round(float(np.median(errors)), 4) if errors else None,
        "error_by_depth": _by_depth(outcomes, matched),
        "intervals": intervals(counts, _frames(outcomes), _boundary_rates),
    }


def _base_rate(matched: Sequence[FrameMatches]) -> float | None:
    """Returns the share of the judged ego sides that have a boundary; None without sides."""
    labeled, empty = sum(len(m.matches) + m.missed for m in matched), sum(m.empty for m in matched)
    return round(labeled / (labeled + empty), 4) if labeled + empty else None


def _boundary_rates(counts: FloatArray) -> dict[str, FloatArray]:
    right, wrong, missed, absent, error, frames = counts.T
    return {
        "precision": ratio(right, right + wrong),
        "recall": ratio(right, right + missed),
        "f1": ratio(2.0 * right, 2.0 * right + wrong + missed),
        "jaccard": ratio(right, right + wrong + missed),
        "accuracy": ratio(right + absent, right + wrong + missed + absent),
        "mean_error_px_640": ratio(error, right),
        "false_per_frame": ratio(wrong, frames),
    }


def _by_depth(outcomes: Sequence[FrameEvaluation], matched: Sequence[FrameMatches]) -> dict[str, Any]:
    """Returns the mean error of right boundaries by depth, from the highest labeled row (0) to the bottom row (1)."""
    total, number = np.zeros(_DEPTH_BINS), np.zeros(_DEPTH_BINS)
    for outcome, frame_matches in zip(outcomes, matched, strict=True):
        for boundary in frame_matches.matches:
            report = outcome.reports[boundary.index]
            rows, errors = errors_along(report, boundary.label, outcome.frame.width)
            bins = np.minimum((_depth(rows, outcome.frame) * _DEPTH_BINS).astype(int), _DEPTH_BINS - 1)
            total += np.bincount(bins, errors, _DEPTH_BINS)
            number += np.bincount(bins, minlength=_DEPTH_BINS)
    means = [round(float(t / n), 4) if n else None for t, n in zip(total, number, strict=True)]
    return {"samples": [int(n) for n in number], "mean_px_640": means}


def _depth(rows: FloatArray, frame: LabeledFrame) -> FloatArray:
    top = min(float(lane.points[:, 1].min()) for lane in frame.lanes)
    return np.clip((rows - top) / max(frame.height - 1.0 - top, 1.0), 0.0, 1.0)


def _tusimple(outcomes: Sequence[FrameEvaluation]) -> dict[str, Any]:
    scores = [tusimple_frame(outcome.reports, outcome.frame) for outcome in outcomes]
    counts = np.array([(s.accuracy, s.fp, s.fn, 1.0) for s in scores]).reshape(-1, 4)
    return {
        "frames": len(outcomes),
        "labels": sum(len(outcome.frame.lanes) for outcome in outcomes),
        **point_estimates(counts, _frames(outcomes), _tusimple_means),
        "intervals": intervals(counts, _frames(outcomes), _tusimple_means),
    }


def _tusimple_means(counts: FloatArray) -> dict[str, FloatArray]:
    accuracy, fp, fn, frames = counts.T
    fp, fn = ratio(fp, frames), ratio(fn, frames)
    return {"accuracy": ratio(accuracy, frames), "fp": fp, "fn": fn, "f1": _harmonic(1.0 - fp, 1.0 - fn)}


def _harmonic(precision: FloatArray, recall: FloatArray) -> FloatArray:
    return ratio(2.0 * precision * recall, precision + recall)


def _culane(outcomes: Sequence[FrameEvaluation]) -> dict[str, Any]:
    counted = [culane_frame(outcome.reports, outcome.frame) for outcome in outcomes]
    counts = np.array([(c.tp, c.fp, c.fn) for c in counted], dtype=float).reshape(-1, 3)
    tp, fp, fn = (int(n) for n in counts.sum(axis=0))
    return {
        "frames": len(outcomes),
        "tp": tp,
        "fp": fp,
        "fn": fn,
        **point_estimates(counts, _frames(outcomes), _culane_rates),
        "intervals": intervals(counts, _frames(outcomes), _culane_rates),
    }


def _culane_rates(counts: FloatArray) -> dict[str, FloatArray]:
    tp, fp, fn = counts.T
    return {"precision": ratio(tp, tp + fp), "recall": ratio(tp, tp + fn), "f1": ratio(2.0 * tp, 2.0 * tp + fp + fn)}


def _frames(outcomes: Sequence[FrameEvaluation]) -> list[LabeledFrame]:
    return [outcome.frame for outcome in outcomes]
