"""Markings, edges of the road or nothing: matching, figures and verdicts on handmade cases."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lanestream.road.appearance import Appearance, BoundaryKind
from lanestream.road.curve import Curve
from lanestream.road.results import LaneBoundary
from lanestream_exporter.datasets.labels import EGO_LANE, PARTIAL, WHOLE, Coverage, LabeledFrame, LabeledLane
from lanestream_exporter.evaluation.boundaries import ReportedBoundary, match, match_ego
from lanestream_exporter.evaluation.figures import boundary_figures, field_figures
from lanestream_exporter.evaluation.kinds import kind_figures
from lanestream_exporter.evaluation.outcomes import FrameEvaluation
from lanestream_exporter.evaluation.verdicts import verdicts

UNMARKED = Coverage(edges=True, markings=False)


def label(b: float, type_name: str | None = "solid", color: str | None = "white") -> LabeledLane:
    rows = np.arange(710.0, 239.0, -10.0)
    x = 640.0 + b * (rows - 200.0)
    inside = (x >= 0.0) & (x <= 1279.0)
    return LabeledLane(np.stack([x, rows], axis=1)[inside], type=type_name, color=color)


def frame(*lanes: LabeledLane, coverage: Coverage = PARTIAL, **conditions: str) -> LabeledFrame:
    return LabeledFrame(1280, 720, lanes, "drive", "drive#0", coverage, conditions=conditions)


def report(b: float, kind: BoundaryKind = "marking", **fields: Any) -> ReportedBoundary:
    return ReportedBoundary(Curve(200.0, (640.0, b, 0.0)), 280.0, 719.0, -1 if b < 0.0 else 1, kind=kind, **fields)


def edge(b: float) -> ReportedBoundary:
    return report(b, "road_edge")


LEFT, RIGHT = label(-1.1), label(1.1)
MIDDLE = label(0.1)
KERB, FAR_KERB = label(-1.1, "kerb", None), label(1.1, "edge", None)


# Matching


def test_a_report_of_another_kind_is_right_and_its_kind_is_counted_apart() -> None:
    outcome = FrameEvaluation(frame(LEFT, FAR_KERB, coverage=WHOLE), (edge(-1.1), report(1.1)))
    matches = match(outcome.reports, outcome.frame.lanes, outcome.frame)
    assert (len(matches.matches), matches.wrong, matches.missed) == (2, 0, 0)
    assert boundary_figures([outcome])["ego"]["right"] == 2
    assert kind_figures([outcome])["confusion"] == {
        "marking": {"marking": 0, "road_edge": 1, "nothing": 0},
        "road_edge": {"marking": 1, "road_edge": 0, "nothing": 0},
        "nothing": {"marking": 0, "road_edge": 0},
    }


def test_of_two_reports_near_a_label_the_one_of_its_kind_is_chosen() -> None:
    """The edge is closer to the label of the marking, but the marking is right."""
    labeled = frame(RIGHT, coverage=WHOLE)
    matches = match([edge(1.1), report(1.13)], labeled.lanes, labeled)
    assert [found.index for found in matches.matches] == [1]
    assert matches.wrong_reports == (0,)


@pytest.mark.parametrize("coverage", [PARTIAL, EGO_LANE, Coverage(open_sides=())])
def test_without_labeled_edges_an_edge_beyond_the_labels_is_unknown(coverage: Coverage) -> None:
    labeled = frame(LEFT, RIGHT, coverage=coverage)
    right = [report(-1.1), report(1.1)]
    assert match([*right, edge(2.0)], labeled.lanes, labeled).wrong == 0
    assert match([*right, edge(1.15)], labeled.lanes, labeled).wrong == 0, "beside the line"
    assert match([*right, edge(0.3)], labeled.lanes, labeled).wrong == 1, "inside the lane"
    assert match([edge(0.3)], (), frame(coverage=coverage)).wrong == 0, "nothing is labeled"


def test_where_edges_are_labeled_an_edge_beyond_the_labels_is_wrong_on_a_complete_side() -> None:
    labeled = frame(LEFT, RIGHT, coverage=WHOLE)
    assert match([edge(2.0)], labeled.lanes, labeled).wrong == 1
    assert match([edge(2.0)], labeled.lanes, replace(labeled, coverage=UNMARKED)).wrong == 0


def test_an_ego_edge_is_judged_by_its_place() -> None:
    labeled = frame(RIGHT, coverage=EGO_LANE)
    found = match_ego([edge(-1.6), edge(1.6)], labeled)
    # Left nothing is labeled, and the edge may be there. Right the marking was missed.
    assert (len(found.matches), found.wrong, found.missed, found.absent, found.empty) == (0, 1, 1, 0, 1)


def test_a_marking_on_a_road_without_any_is_wrong_wherever_it_is_not_labeled() -> None:
    labeled = frame(KERB, FAR_KERB, coverage=UNMARKED)
    matches = match([report(-1.1), report(2.5), edge(2.5)], labeled.lanes, labeled)
    assert [found.index for found in matches.matches] == [0]
    assert matches.wrong_reports == (1,)


# Figures


def test_false_markings_are_counted_by_frame_even_on_a_labeled_edge() -> None:
    outcomes = [
        FrameEvaluation(frame(KERB, coverage=UNMARKED, markings="no"), (report(-1.1), report(0.5))),
        FrameEvaluation(frame(KERB, coverage=UNMARKED, markings="no"), (edge(-1.1),)),
        FrameEvaluation(frame(KERB, coverage=UNMARKED, markings="yes"), (report(0.5),)),
        FrameEvaluation(frame(LEFT, coverage=WHOLE), (report(-1.1),)),
    ]
    false = kind_figures(outcomes)["false_markings"]
    unmarked, unpainted = false["unmarked"], false["unpainted"]
    assert (unmarked["frames"], unmarked["with_marking"], unmarked["markings"]) == (3, 2, 3)
    assert unmarked["share"] == pytest.approx(2 / 3, abs=1e-4)
    assert (unpainted["frames"], unpainted["with_marking"], unpainted["share"]) == (2, 1, 0.5)


def test_precision_and_recall_of_edges() -> None:
    outcomes = [
        # One edge right, one reported as a marking, and a marking reported as an edge.
        FrameEvaluation(frame(KERB, MIDDLE, FAR_KERB, coverage=WHOLE), (edge(-1.1), edge(0.1), report(1.1))),
        FrameEvaluation(frame(KERB, coverage=WHOLE), (edge(-1.1), edge(0.6))),
        # Edges are not labeled here.
        FrameEvaluation(frame(LEFT), (edge(-1.1), edge(0.5))),
    ]
    edges = kind_figures(outcomes)["road_edges"]
    assert (edges["frames"], edges["labeled"], edges["right"], edges["wrong"]) == (2, 3, 2, 2)
    assert edges["precision"] == 0.5
    assert edges["recall"] == pytest.approx(2 / 3, abs=1e-4)


def test_types_and_colors_of_right_markings() -> None:
    yellow = label(1.1, "double", "yellow")
    outcomes = [
        FrameEvaluation(frame(LEFT, yellow), (typed(-1.1, "dashed", "white"), typed(1.1, "double", "yellow"))),
        FrameEvaluation(frame(LEFT, label(1.1, None, "white")), (report(-1.1), typed(1.1, "dashed", "yellow"))),
        # Neither a kerb nor a marking that is reported as an edge has a type.
        FrameEvaluation(frame(KERB, RIGHT), (typed(-1.1, "solid", "white"), edge(1.1))),
    ]
    figures = kind_figures(outcomes)
    types, colors = figures["types"], figures["colors"]
    assert types["confusion"]["solid"] == {"solid": 0, "dashed": 1, "double": 0, "dots": 0, "unknown": 1}
    assert types["confusion"]["double"]["double"] == 1
    assert (types["markings"], types["right"]) == (3, 1)
    assert types["constant_share"] == pytest.approx(2 / 3, abs=1e-4)
    assert colors["confusion"] == {
        "white": {"white": 1, "yellow": 1, "unknown": 1},
        "yellow": {"white": 0, "yellow": 1, "unknown": 0},
    }
    assert (colors["right_share"], colors["constant_share"]) == (0.5, 0.75)


def typed(b: float, type_name: str, color: str) -> ReportedBoundary:
    return report(b, type=type_name, color=color)


def test_the_most_probable_kind_type_and_color_are_reported() -> None:
    marking = Appearance(0.2, (0.1, 0.6, 0.2, 0.1), (0.3, 0.7))
    found = ReportedBoundary.from_lane(tracked(marking))
    assert (found.kind, found.type, found.color) == ("marking", "dashed", "yellow")
    found = ReportedBoundary.from_lane(tracked(replace(marking, road_edge=0.9)))
    assert (found.kind, found.type, found.color) == ("road_edge", None, None)
    assert ReportedBoundary.from_lane(tracked(Appearance())).type is None


def tracked(appearance: Appearance) -> LaneBoundary:
    curve = Curve(200.0, (640.0, 1.0, 0.0))
    return LaneBoundary(1, 1, "detected", 0.9, curve, np.eye(3), 250.0, 700.0, 1.0, appearance=appearance)


def test_the_benchmarks_see_markings_only() -> None:
    marked = FrameEvaluation(frame(LEFT, RIGHT), (report(-1.1), report(1.1)))
    with_edges = FrameEvaluation(frame(LEFT, RIGHT, label(2.2, "kerb", None)), (*marked.reports, edge(2.2), edge(0.3)))
    unmarked = FrameEvaluation(frame(KERB, coverage=UNMARKED), (edge(-1.1),))
    assert field_figures([with_edges, unmarked]) == field_figures([marked])


def test_the_base_rate_is_the_share_of_ego_sides_with_a_boundary() -> None:
    outcomes = [FrameEvaluation(frame(LEFT, RIGHT), ()), FrameEvaluation(frame(RIGHT, coverage=EGO_LANE), ())]
    figures = boundary_figures(outcomes)
    assert (figures["ego"]["base_rate"], figures["all"]["base_rate"]) == (0.75, None)


# Verdicts


def figures_of(outcomes: list[FrameEvaluation]) -> dict[str, Any]:
    groups = {"boundaries": boundary_figures(outcomes), "kinds": kind_figures(outcomes), "reliability": {}}
    return {
        "methods": {"net": {}},
        "images": {"net": {"overall": groups}},
        "datasets": {"net": {"town": groups}},
        "clips": {"net": {}},
        "no_road": {"net": {}},
        "towns": {},
        "stills": {},
    }


def test_verdicts_of_an_unmarked_road() -> None:
    kerb = frame(KERB, FAR_KERB, coverage=UNMARKED, markings="no")
    lines = verdicts(
        figures_of([FrameEvaluation(kerb, (edge(-1.1), edge(1.1))), FrameEvaluation(kerb, (report(0.3),))])
    )
    assert lines[0].startswith("net: ego boundaries: 2 of 4 right, 1 wrong, 0.0 px off at 640 wide; all boundaries: ")
    assert "unmarked roads: a marking reported in 1 of 2 frames, 1 of 2 where nothing at all is painted" in lines
    assert "road edges: 2 of 4 reported as such, and 0 reports of an edge wrong" in lines
    assert lines[-1].endswith("base rate town 100 %")


def test_verdicts_of_markings_and_a_warning_only_above_the_base_rate() -> None:
    labeled = frame(RIGHT, coverage=EGO_LANE)
    lines = verdicts(figures_of([FrameEvaluation(labeled, (typed(1.1, "solid", "yellow"),))]))
    assert "types of markings, single images: 1 of 1 right; always the most frequent one: 1" in lines
    assert any(line.startswith("town: 1 frames") and line.endswith("color right on 0 of 1 markings") for line in lines)
    assert not any("warning" in line or "unmarked" in line or "edge" in line for line in lines)
    unclassified = verdicts(figures_of([FrameEvaluation(labeled, (report(1.1),))]))
    assert "types of markings: not classified" in unclassified
