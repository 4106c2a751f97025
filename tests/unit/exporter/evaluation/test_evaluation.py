"""The rules of evaluation on handmade cases: the ego pair, benchmark metrics, intervals, steadiness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lanestream.detection.classification import Classification
from lanestream.detection.features import Channels
from lanestream.detection.proposals import Proposals
from lanestream.road.curve import Curve, Curves
from lanestream.road.view import RoadView, Spans
from lanestream_exporter.datasets.labels import EGO_LANE, PARTIAL, WHOLE, Coverage, LabeledFrame, LabeledLane
from lanestream_exporter.evaluation.benchmarks import (
    TUSIMPLE_ROWS,
    culane_counts,
    tusimple_frame,
    tusimple_score,
)
from lanestream_exporter.evaluation.bootstrap import blocks, intervals, point_estimates, ratio
from lanestream_exporter.evaluation.boundaries import ReportedBoundary, match, match_ego
from lanestream_exporter.evaluation.candidates import candidate_figures
from lanestream_exporter.evaluation.figures import boundary_figures, field_figures
from lanestream_exporter.evaluation.lateral import lateral_figures
from lanestream_exporter.evaluation.outcomes import RULES, FrameEvaluation, judge
from lanestream_exporter.evaluation.steadiness import steadiness

Array = NDArray[np.float64]


def curve(b: float, v: float = 640.0) -> Curve:
    return Curve(200.0, (v, b, 0.0))


def label(b: float, top: float = 240.0, position: int | None = None, lane_id: int | None = None) -> LabeledLane:
    rows = np.arange(710.0, top - 1.0, -10.0)
    x = curve(b).x(rows)
    inside = (x >= 0.0) & (x <= 1279.0)
    return LabeledLane(np.stack([x, rows], axis=1)[inside], lane_id, position)


def frame(*lanes: LabeledLane, coverage: Coverage = PARTIAL, group: str = "drive", number: int = 0) -> LabeledFrame:
    return LabeledFrame(1280, 720, lanes, group, f"{group}#{number}", coverage)


def report(b: float, position: int, v: float = 640.0, track_id: int | None = None) -> ReportedBoundary:
    return ReportedBoundary(curve(b, v), 280.0, 719.0, position, track_id)


PAIR = label(-1.1), label(1.1)


# The ego pair


def test_an_ego_report_away_from_its_label_is_wrong_even_on_an_incomplete_side() -> None:
    matches = match_ego([report(-2.2, -1), report(1.1, 1)], frame(*PAIR))
    assert (len(matches.matches), matches.wrong, matches.missed) == (1, 1, 1)
    assert match([report(-2.2, -1), report(1.1, 1)], PAIR, frame(*PAIR)).wrong == 0


def test_an_ego_report_must_be_on_its_own_side() -> None:
    matches = match_ego([report(-1.1, 1), report(1.1, -1)], frame(*PAIR))
    assert (len(matches.matches), matches.wrong, matches.missed) == (0, 2, 2)


def test_an_absent_side_counts_if_the_ego_lane_is_completely_labeled() -> None:
    alone = label(1.1, position=1)
    matches = match_ego([report(1.1, 1)], frame(alone, coverage=EGO_LANE))
    assert (len(matches.matches), matches.wrong, matches.missed, matches.absent) == (1, 0, 0, 1)
    assert match_ego([report(1.1, 1)], frame(alone)).absent == 0
    reported = match_ego([report(-1.1, -1)], frame(alone, coverage=EGO_LANE))
    assert (reported.wrong, reported.missed, reported.absent) == (1, 1, 0)


def test_boundary_figures_of_two_frames() -> None:
    outcomes = [
        FrameEvaluation(frame(*PAIR, coverage=WHOLE), (report(-1.1, -1, 650.0), report(1.1, 1))),
        FrameEvaluation(frame(*PAIR, coverage=WHOLE), (report(-1.1, -1), report(0.3, 1))),
    ]
    ego = boundary_figures(outcomes)["ego"]
    assert (ego["right"], ego["wrong"], ego["missed"], ego["absent"]) == (3, 1, 1, 0)
    assert (ego["precision"], ego["recall"], ego["f1"]) == (0.75, 0.75, 0.75)
    assert (ego["jaccard"], ego["accuracy"], ego["false_per_frame"]) == (0.6, 0.6, 0.5)
    distance = 5.0 / np.hypot(1.0, 1.1)
    assert ego["mean_error_px_640"] == pytest.approx(distance / 3.0, abs=1e-3)
    assert ego["median_error_px_640"] == 0.0
    means = [m for m in ego["error_by_depth"]["mean_px_640"] if m is not None]
    assert len(means) >= 9
    assert means == pytest.approx([distance / 3.0] * len(means), abs=0.05)
    assert sum(ego["error_by_depth"]["samples"]) == 3 * 58  # those of 64 rows that are below row 280


def test_lateral_errors_of_the_curve_and_of_its_straight_extrapolation() -> None:
    curved = Curve(200.0, (640.0, -1.1, 2000.0))
    outcomes = [
        FrameEvaluation(frame(*PAIR, number=i), (ReportedBoundary(curved, 280.0, 719.0, -1), report(1.1, 1)))
        for i in range(2)
    ]
    near, far = (lateral_figures(outcomes)[distance] for distance in ("10m", "30m"))
    row = 200.0 + 0.5 / np.tan(np.deg2rad(32.5)) * 1280 * 1.45 / 30.0
    assert (far["labeled"], far["reported"], far["reached"]) == (4, 4, 0)
    assert far["mean_px_640"] == pytest.approx(0.5 * 0.5 * 2000.0 / (row - 200.0), rel=0.02)
    straight = 2000.0 / 80.0 - (row - 280.0) * 2000.0 / 80.0**2
    assert far["straight_px_640"] == pytest.approx(0.5 * 0.5 * straight, rel=0.02)
    assert near["reached"] == 4
    assert near["mean_px_640"] == near["straight_px_640"]


def test_figures_without_data_are_none() -> None:
    figures = boundary_figures([FrameEvaluation(frame(coverage=WHOLE), ())])
    assert figures["all"]["precision"] is None
    assert figures["all"]["mean_error_px_640"] is None
    assert figures["ego"]["accuracy"] == 1.0


# TuSimple


def lane(x: float, first: int = 0, last: int = 48) -> Array:
    columns = np.full(48, -2.0)
    columns[first:last] = x
    return columns


def score(reported: list[Array], labels: list[Array]) -> tuple[float, float, float]:
    result = tusimple_score(reported, labels, TUSIMPLE_ROWS)
    return result.accuracy, result.fp, result.fn


def test_tusimple_threshold_is_below_20_pixels() -> None:
    assert score([lane(119.9)], [lane(100.0)]) == (1.0, 0.0, 0.0)
    assert score([lane(120.0)], [lane(100.0)]) == (0.0, 1.0, 1.0)


def test_tusimple_threshold_grows_with_the_labels_angle() -> None:
    slanted = 100.0 + 1.5 * (TUSIMPLE_ROWS - 240.0)
    limit = 20.0 * np.hypot(1.0, 1.5)
    assert score([slanted + limit - 0.1], [slanted])[0] == 1.0
    assert score([slanted + limit + 0.1], [slanted])[0] == 0.0


def test_tusimple_rows_where_both_are_absent_are_right() -> None:
    assert score([lane(100.0, 10)], [lane(100.0, 10)]) == (1.0, 0.0, 0.0)
    accuracy, fp, fn = score([lane(100.0, 10)], [lane(100.0)])
    assert accuracy == pytest.approx(38 / 48)
    assert (fp, fn) == (1.0, 1.0)


def test_tusimple_needs_85_percent_of_rows() -> None:
    accuracy, fp, fn = score([lane(100.0, 7)], [lane(100.0)])
    assert accuracy == pytest.approx(41 / 48)  # 0.854
    assert (fp, fn) == (0.0, 0.0)
    assert score([lane(100.0, 8)], [lane(100.0)])[1:] == (1.0, 1.0)  # 0.833


def test_tusimple_is_not_one_to_one() -> None:
    """One report matches two labels, so there are more matches than reports and FP is negative, as in the original."""
    accuracy, fp, fn = score([lane(110.0)], [lane(100.0), lane(120.0)])
    assert (accuracy, fp, fn) == (1.0, -1.0, 0.0)


def test_tusimple_more_than_two_extra_reports_void_a_frame() -> None:
    reports = [lane(100.0 + 200.0 * i) for i in range(4)]
    assert score(reports[:3], [lane(100.0)]) == (1.0, pytest.approx(2 / 3), 0.0)
    assert score(reports, [lane(100.0)]) == (0.0, 0.0, 1.0)


def test_tusimple_forgives_the_worst_of_five_labels() -> None:
    labels = [lane(100.0 + 200.0 * i) for i in range(5)]
    assert score(labels[:4], labels) == (1.0, 0.0, 0.0)
    accuracy, fp, fn = score(labels[:3], labels)
    assert (accuracy, fp, fn) == (0.75, 0.0, 0.25)
    assert score(labels[:3], labels[:4]) == (0.75, 0.0, 0.25)


def test_tusimple_without_reports_or_labels() -> None:
    assert score([], [lane(100.0)]) == (0.0, 0.0, 1.0)
    assert score([], []) == (0.0, 0.0, 0.0)
    assert score([lane(100.0)], []) == (0.0, 1.0, 0.0)


def test_tusimple_frames_are_scaled_and_reports_extrapolated() -> None:
    wanted = frame(label(-1.1), label(1.1))
    perfect = tusimple_frame([report(-1.1, -1), report(1.1, 1)], wanted)
    assert perfect.accuracy == 1.0  # although the reports end at row 280 and the labels at 240
    half = LabeledFrame(640, 360, tuple(LabeledLane(i.points / 2.0) for i in wanted.lanes), "d", "d#0")
    reports = [ReportedBoundary(Curve(100.0, (320.0, b, 0.0)), 140.0, 359.0, s) for b, s in ((-1.1, -1), (1.1, 1))]
    assert tusimple_frame(reports, half) == perfect
    cut = [replace(report, farthest=300.0) for report in reports]
    assert tusimple_frame(cut, half).accuracy < 0.5


def test_boundaries_beyond_the_adjacent_lanes_are_not_submitted() -> None:
    reports = [report(-1.1, -1), report(1.1, 1), report(5.0, 3)]
    assert tusimple_frame(reports, frame(*PAIR)).fp == 0.0
    assert tusimple_frame([*reports, report(3.3, 2)], frame(*PAIR)).fp == pytest.approx(1 / 3)


# CULane style

SIZE = (1640, 590)


def upright(x: float, top: float = 100.0) -> Array:
    return np.array([[x, 589.0], [x, top]])


def counts(reported: list[Array], labels: list[Array]) -> tuple[int, int, int]:
    result = culane_counts(reported, labels, SIZE)
    return result.tp, result.fp, result.fn


def test_stripes_30_pixels_wide_overlap_by_half_up_to_10_pixels() -> None:
    """Shifted by d, the IoU of two stripes is (30 - d) / (30 + d), which is above 0.5 for d below 10."""
    assert counts([upright(507.0)], [upright(500.0)]) == (1, 0, 0)
    assert counts([upright(513.0)], [upright(500.0)]) == (0, 1, 1)


def test_stripes_are_scaled_with_the_width() -> None:
    labels, size = [upright(500.0) / 2.0], (820, 295)
    assert culane_counts([labels[0] + [3.0, 0.0]], labels, size).tp == 1
    assert culane_counts([labels[0] + [7.0, 0.0]], labels, size).tp == 0


def test_a_stripe_matches_one_label_and_a_short_stripe_none() -> None:
    assert counts([upright(500.0), upright(503.0)], [upright(500.0)]) == (1, 1, 0)
    assert counts([upright(500.0, 400.0)], [upright(500.0)]) == (0, 1, 1)
    assert counts([], [upright(500.0)]) == (0, 0, 1)
    assert counts([upright(500.0)], []) == (0, 1, 0)


def test_stripes_are_matched_for_the_largest_total_overlap() -> None:
    """Matching the nearest pair first would leave 495 with 512, which are too far apart."""
    assert counts([upright(505.0), upright(495.0)], [upright(502.0), upright(512.0)]) == (2, 0, 0)


def test_ego_pair_figures_ignore_other_boundaries() -> None:
    outer = label(3.0)
    outcomes = [
        FrameEvaluation(frame(*PAIR, outer), (report(-1.1, -1), report(1.1, 1), report(2.2, 2))),
        FrameEvaluation(frame(label(3.0, position=2)), (report(1.1, 1),)),
    ]
    figures = field_figures(outcomes)
    assert (figures["tusimple"]["frames"], figures["tusimple"]["labels"]) == (2, 4)
    assert figures["tusimple"]["fp"] == pytest.approx(0.5 * (1.0 / 3.0 + 1.0), abs=1e-4)
    ego = figures["ego"]
    assert (ego["tusimple"]["frames"], ego["tusimple"]["labels"]) == (1, 2)
    assert (ego["tusimple"]["fp"], ego["tusimple"]["fn"]) == (0.0, 0.0)
    assert (ego["culane"]["tp"], ego["culane"]["fp"], ego["culane"]["fn"]) == (2, 0, 0)


def test_field_figures_over_a_set() -> None:
    outcomes = [
        FrameEvaluation(frame(*PAIR), (report(-1.1, -1), report(1.1, 1))),
        FrameEvaluation(frame(*PAIR), (report(-1.1, -1),)),
    ]
    figures = field_figures(outcomes)
    assert figures["tusimple"]["accuracy"] == 0.75
    assert figures["tusimple"]["labels"] == 4
    assert (figures["culane"]["tp"], figures["culane"]["fp"], figures["culane"]["fn"]) == (3, 0, 1)
    assert figures["culane"]["f1"] == pytest.approx(6 / 7, abs=1e-4)


# Candidates


def test_candidates_under_both_rules() -> None:
    view = RoadView(1280, 720, 200.0)
    labels = frame(*PAIR, coverage=WHOLE)
    # Shifts of 10, 52 and 90 px are 6.7, 35 and 60 px across the line, at 1280 wide.
    shifts = (0.0, 10.0, 52.0, 90.0)
    spans = Spans(np.full(4, 252.0), np.full(4, 719.0), np.ones(4, bool))
    channels = Channels.of(np.zeros((720, 1280, 3), np.uint8))
    proposals = Proposals(channels, Curves.of([curve(-1.1, 640.0 + v) for v in shifts]), spans, view, 1.0, None)
    outputs = Classification.of(np.array([[0.05, 0.95], [0.75, 0.25], [0.05, 0.95], [0.85, 0.15]], np.float32))
    judged = judge(proposals, outputs, labels)
    figures = candidate_figures([FrameEvaluation(labels, (), judged)], 0.5)
    assert figures["far_40"]["confusion"] == {"tp": 1, "fp": 0, "fn": 1, "tn": 1}
    assert (figures["far_40"]["unsure"], figures["far_30"]["unsure"]) == (1, 0)
    assert figures["far_30"]["confusion"] == {"tp": 1, "fp": 1, "fn": 1, "tn": 1}
    assert figures["far_30"]["base_rate"] == 0.5
    assert figures["far_40"]["balanced_accuracy"] == 0.75
    assert figures["far_40"]["average_precision"] == 1.0
    bins = figures["far_40"]["calibration"]["bins"]
    assert [b["count"] for b in bins] == [0, 1, 1, 0, 0, 0, 0, 0, 0, 1]
    assert figures["far_40"]["calibration"]["expected_error"] == pytest.approx((0.05 + 0.75 + 0.15) / 3, abs=1e-3)
    assert figures["decided"] == {rule: figures[rule] for rule in RULES}, "without a prior the classifier decides"
    with_prior = replace(judged, decided=np.array([0.95, 0.75, 0.95, 0.15]))
    decided = candidate_figures([FrameEvaluation(labels, (), with_prior)], 0.5)
    assert decided["decided"]["far_40"]["confusion"] == {"tp": 2, "fp": 0, "fn": 0, "tn": 1}
    assert decided["far_40"] == figures["far_40"]
    reverse = replace(proposals, curves=proposals.curves.take([3, 2, 1, 0]))
    ranked = candidate_figures([FrameEvaluation(labels, (), judge(reverse, outputs.take(np.arange(2)), labels))], 0.5)
    assert ranked["far_30"]["candidates"] == 2, "only those that the classifier saw are judged"
    recall = ranked["proposal_recall"]["ego"]
    assert recall["labels"] == 2
    assert recall["found"][:4] == [0, 0, 1, 1]  # the third of the reversed list is the first true one
    assert recall["recall_16"] == 0.5


# Intervals


def rates(sums: Array) -> dict[str, Array]:
    return {"share": ratio(sums[:, 0], sums[:, 1])}


def test_blocks_are_neighboring_frames_or_whole_drives_if_there_are_many() -> None:
    stills = [replace(frame(group=g), source=f"{g}/{i}.jpg") for g in "ab" for i in range(7)]
    assert blocks(stills).tolist() == [0] * 5 + [1] * 2 + [2] * 5 + [3] * 2
    clip = [frame(number=15 * i) for i in range(9)]
    assert blocks(clip).tolist() == [0] * 4 + [1] * 4 + [2]
    assert blocks([frame(number=400 * i) for i in range(4)]).tolist() == [0, 0, 1, 1]
    drives = [frame(group=f"g{i // 8}", number=i) for i in range(80)]
    assert blocks(drives).tolist() == [i // 8 for i in range(80)]


def test_intervals_are_reproducible_and_depend_on_the_blocks() -> None:
    frames = [replace(frame(), source=f"{i}.jpg") for i in range(200)]
    alternating = np.array([[i % 2, 1.0] for i in range(200)])
    grouped = np.array([[(i // 5) % 2, 1.0] for i in range(200)])
    assert intervals(grouped, frames, rates) == intervals(grouped, frames, rates)
    assert point_estimates(grouped, frames, rates) == {"share": 0.5}
    wide, narrow = intervals(grouped, frames, rates)["share"], intervals(alternating, frames, rates)["share"]
    assert wide is not None
    assert narrow is not None
    # 40 blocks of 0 or 1: plus or minus 1.96 times 0.5 / sqrt(40).
    assert wide == pytest.approx([0.5 - 0.155, 0.5 + 0.155], abs=0.03)
    assert narrow[1] - narrow[0] < 0.3 * (wide[1] - wide[0])


def test_one_block_has_no_interval() -> None:
    assert intervals(np.array([[1.0, 1.0]]), [frame()], rates) == {"share": None}
    assert intervals(np.zeros((0, 2)), [], rates) == {"share": None}


# Steadiness


def test_steadiness_of_a_clip() -> None:
    jittering = [640.0 + (8.0 if i % 2 else 0.0) for i in range(10)]
    reported = [(report(-1.1, -1, v, track_id=7), report(1.1, 1, track_id=8)) for v in jittering]
    reported[9] = (report(-1.1, -1, track_id=7),)
    labels = [label(-1.1, position=-1, lane_id=1), label(1.1, position=1, lane_id=2)]
    labeled = [FrameEvaluation(frame(*labels, number=i), reported[i]) for i in (0, 4, 8)]
    figures = steadiness(reported, labeled, (1280, 720))
    assert (figures["frames"], figures["both_ego_frames"], figures["both_ego"]) == (10, 9, 0.9)
    # Left: second differences of plus and minus 8 px at 640 wide; right: zero.
    assert figures["jitter_samples"] == 3 * (8 + 7)
    assert figures["jitter_px_640"] == pytest.approx(8.0 * np.sqrt(8 / 15), abs=0.3)
    assert figures["id_switches"] == 0
    swapped = [
        *labeled[:2],
        FrameEvaluation(labeled[2].frame, (report(-1.1, -1, track_id=9), report(1.1, 1, track_id=8))),
    ]
    assert steadiness(reported, swapped, (1280, 720))["id_switches"] == 1


def test_reports_without_track_ids_have_no_identity_switches() -> None:
    reported = [(report(-1.1, -1), report(1.1, 1))]
    figures = steadiness(reported, [FrameEvaluation(frame(*PAIR), reported[0])], (1280, 720))
    assert figures["id_switches"] is None
    assert figures["jitter_px_640"] is None
