"""Pictures without a road in an evaluation: what is counted, and that no picture is one of those for training."""

from __future__ import annotations

from itertools import islice
from typing import Any

import numpy as np
import pytest

from lanestream.road.appearance import BoundaryKind
from lanestream.road.curve import Curve
from lanestream.road.view import Image
from lanestream_exporter.evaluation.baselines import HoughLinesBaseline
from lanestream_exporter.evaluation.boundaries import ReportedBoundary
from lanestream_exporter.evaluation.measuring import OVERALL, Evaluation, EvaluationSet
from lanestream_exporter.evaluation.methods import Baseline
from lanestream_exporter.evaluation.no_road import NoRoadOutcome, no_road_figures, no_road_pictures, run_no_road
from lanestream_exporter.evaluation.tables import figure_tables
from lanestream_exporter.evaluation.verdicts import verdicts
from lanestream_exporter.scenes import sample_picture
from lanestream_exporter.scenes.no_road import KINDS


def report(position: int, kind: BoundaryKind = "marking") -> ReportedBoundary:
    return ReportedBoundary(Curve(200.0, (640.0, float(position), 0.0)), 280.0, 719.0, position, kind=kind)


LEFT, RIGHT, EDGE = report(-1), report(1), report(2, "road_edge")


class WideOnly:
    """Reports a lane in wide pictures, an edge in upright ones, and nothing in others."""

    name = "wide only"

    def detect(self, image: Image) -> tuple[ReportedBoundary, ...]:
        height, width = image.shape[:2]
        if height > width:
            return (EDGE,)
        return (LEFT, RIGHT) if width / height > 1.5 else ()


def test_boundaries_markings_and_ego_lanes_are_counted_by_picture() -> None:
    reports = [(), (LEFT, RIGHT), (LEFT,), (EDGE,), (LEFT, report(2)), (report(-1, "road_edge"), RIGHT)]
    figures = no_road_figures([NoRoadOutcome("sky", found) for found in reports])
    assert (figures["pictures"], figures["with_boundary"]) == (6, 5)
    assert (figures["with_marking"], figures["with_ego_lane"]) == (4, 2)
    assert figures["share"] == pytest.approx(5 / 6, abs=1e-4)
    low, high = figures["intervals"]["share"]
    assert 0.3 < low < 0.4 < 0.99 < high < 1.0


def test_no_report_in_200_pictures_still_leaves_some_doubt() -> None:
    figures = no_road_figures([NoRoadOutcome("sky", ())] * 200)
    assert figures["intervals"]["share"] == [0.0, pytest.approx(1.0 - 0.025 ** (1 / 200), abs=1e-4)]


@pytest.fixture(scope="module")
def evaluation() -> Evaluation:
    methods = (Baseline(WideOnly()), Baseline(HoughLinesBaseline()))
    names = [method.name for method in methods]
    pictures = run_no_road(methods, 8)
    images: dict[str, Any] = {name: [] for name in names}
    return Evaluation(EvaluationSet("none", lambda: iter(())), methods, images, {name: {} for name in names}, pictures)


def test_every_method_gets_the_same_pictures(evaluation: Evaluation) -> None:
    figures = evaluation.figures()["no_road"]
    assert [part[OVERALL]["pictures"] for part in figures.values()] == [8, 8]
    wide, hough = figures.values()
    assert list(wide) == list(hough)
    assert set(wide) <= {OVERALL, *KINDS}
    # The sizes of the pictures take turns: wide, nearly square, wide, upright.
    assert [wide[OVERALL][f"with_{name}"] for name in ("boundary", "marking", "ego_lane")] == [6, 4, 4]
    assert sum(part["with_boundary"] for kind, part in wide.items() if kind != OVERALL) == 6


def test_the_verdicts_and_a_table_have_the_counts(evaluation: Evaluation) -> None:
    figures = evaluation.figures()
    line = "pictures without a road: a boundary reported in 6 of 8, a marking in 4, both ego boundaries in 4"
    assert line in verdicts(figures)
    titles = [str(table.title) for table in figure_tables(figures)]
    assert "Pictures without a road in which something is reported" in titles
    none = {**figures, "no_road": {name: {} for name in figures["no_road"]}}
    assert not any("without a road" in line for line in verdicts(none))
    assert not any("without a road" in str(table.title) for table in figure_tables(none))


def test_a_longer_series_begins_with_the_same_pictures_of_many_kinds() -> None:
    shorter = list(no_road_pictures(3))
    for (kind, image), (same_kind, same) in zip(shorter, islice(no_road_pictures(5), 3), strict=True):
        assert kind == same_kind
        np.testing.assert_array_equal(image, same)
    assert len({kind for kind, _ in no_road_pictures(40)}) >= 10


def test_the_pictures_are_not_those_for_training() -> None:
    _, image = next(no_road_pictures(1))
    height, width = image.shape[:2]
    for_training = sample_picture(np.random.default_rng([0, 0, 3]), width, height)
    assert np.any(image != for_training)
