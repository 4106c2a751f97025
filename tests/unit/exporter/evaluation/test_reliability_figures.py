"""Reliability of reported boundaries, rendered towns, and stills, on handmade reports."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lanestream.road.curve import Curve
from lanestream.road.view import Image
from lanestream_exporter.datasets.labels import WHOLE, LabeledFrame, LabeledLane
from lanestream_exporter.evaluation.boundaries import ReportedBoundary
from lanestream_exporter.evaluation.methods import ClipTracker
from lanestream_exporter.evaluation.outcomes import FrameEvaluation
from lanestream_exporter.evaluation.reliability import reliability_figures
from lanestream_exporter.evaluation.stills import FRAMES, StillOutcome, by_source, run_stills, still_figures
from lanestream_exporter.evaluation.towns import run_towns, town_figures, town_frames
from lanestream_exporter.evaluation.verdicts import verdicts

WIDTH, HEIGHT = 1280, 720


def label(b: float) -> LabeledLane:
    rows = np.arange(710.0, 239.0, -10.0)
    return LabeledLane(np.stack([640.0 + b * (rows - 200.0), rows], axis=1))


def report(b: float, position: int, probability: float | None, shift: float = 0.0) -> ReportedBoundary:
    curve = Curve(200.0, (640.0 + shift, b, 0.0))
    return ReportedBoundary(curve, 240.0, 719.0, position, probability=probability)


def frame(*lanes: LabeledLane) -> LabeledFrame:
    return LabeledFrame(WIDTH, HEIGHT, lanes, "drive", "drive#0", WHOLE)


ROAD = frame(label(-1.1), label(1.1), label(3.0))
REPORTS = (report(-1.1, -1, 0.95), report(1.1, 1, 0.55), report(2.2, 2, 0.85), report(3.0, 3, 0.65))


def trade(part: dict[str, Any], least: float) -> tuple[Any, ...]:
    row = next(row for row in part["trade"] if row["least"] == least)
    return row["right"], row["wrong"], row["precision"], row["found"], row["recall"]


def test_the_ego_pair_and_outer_boundaries_are_judged_apart() -> None:
    figures = reliability_figures([FrameEvaluation(ROAD, REPORTS)])
    assert (figures["ego"]["reports"], figures["ego"]["labels"]) == (2, 2)
    assert (figures["outer"]["reports"], figures["outer"]["labels"]) == (2, 1)
    assert trade(figures["ego"], 0.5) == (2, 0, 1.0, 2, 1.0)
    assert trade(figures["ego"], 0.6) == (1, 0, 1.0, 1, 0.5)
    assert trade(figures["outer"], 0.0) == (1, 1, 0.5, 1, 1.0)
    assert trade(figures["outer"], 0.7) == (0, 1, 0.0, 0, 0.0)
    assert trade(figures["outer"], 0.9) == (0, 0, None, 0, 0.0)
    bins = {row["low"]: (row["count"], row["true_share"]) for row in figures["outer"]["calibration"]["bins"]}
    assert (bins[0.6], bins[0.8], bins[0.9]) == ((1, 1.0), (1, 0.0), (0, None))


def test_an_ego_boundary_is_found_by_a_report_that_counts_as_an_outer_one() -> None:
    nearer = (report(0.6, 1, 0.9), report(1.1, 2, 0.8))
    figures = reliability_figures([FrameEvaluation(frame(label(-1.1), label(1.1)), nearer)])
    assert trade(figures["ego"], 0.5) == (0, 1, 0.0, 1, 0.5)
    assert trade(figures["outer"], 0.5) == (1, 0, 1.0, 0, None)


@pytest.mark.parametrize("reports", [(), (report(1.1, 1, None),)], ids=["no reports", "no probabilities"])
def test_a_method_without_probabilities_has_no_reliability(reports: tuple[ReportedBoundary, ...]) -> None:
    assert reliability_figures([FrameEvaluation(ROAD, reports)]) == {}


class Scripted:
    """Reports the same in every single image, and in a stream what `streamed` returns for the number of the frame."""

    kind, threshold, regressor = "classifier", None, None

    def __init__(self, name: str, alone: tuple[ReportedBoundary, ...], kind: str = "classifier") -> None:
        self.name, self.alone, self.kind = name, alone, kind
        self.streams: list[int] = []

    def find(self, image: Image) -> tuple[ReportedBoundary, ...]:
        return self.alone

    def detect(self, image: Image, frame: LabeledFrame) -> FrameEvaluation:
        return FrameEvaluation(frame, self.alone)

    def start_clip(self) -> ClipTracker:
        self.streams.append(0)

        def track(image: Image, timestamp: float) -> tuple[ReportedBoundary, ...]:
            assert timestamp == pytest.approx(self.streams[-1] / 25.0)
            self.streams[-1] += 1
            return self.alone[1:] if self.streams[-1] == FRAMES else self.alone

        return track


def test_a_still_loses_what_its_last_frame_does_not_show() -> None:
    moved = StillOutcome("rendered", REPORTS[:2], (report(-1.1, -1, 0.5, 20.0), report(1.1, 1, 0.9, 90.0)), WIDTH)
    assert (moved.lost, moved.gained) == (1, 1), "29 pixels across the line at most"
    kept = replace(moved, streamed=REPORTS[1:3])
    assert (kept.lost, kept.gained) == (1, 1)
    assert still_figures([moved, kept, replace(moved, streamed=REPORTS[:2])]) == {
        "stills": 3,
        "boundaries": 6,
        "with_loss": 2,
        "lost": 2,
        "gained": 2,
    }
    apart = (replace(REPORTS[0], top=240.0, bottom=300.0), replace(REPORTS[0], top=310.0, bottom=700.0))
    assert StillOutcome("x", apart[:1], apart[1:], WIDTH).lost == 1, "no row in common"


def test_stills_are_frames_of_every_data_set_and_rendered_pictures() -> None:
    frames = [replace(ROAD, dataset=f"set {number % 2}") for number in range(20)]
    given: list[int] = []

    def images() -> Iterator[tuple[LabeledFrame, Image]]:
        for number, labels in enumerate(frames):
            given.append(number)
            yield labels, np.full((HEIGHT, WIDTH, 3), number, np.uint8)

    methods = [Scripted("a", REPORTS), Scripted("baseline", REPORTS, "baseline")]
    outcomes = run_stills(methods, images(), frames, 12)
    assert list(outcomes) == ["a"], "a baseline has no memory"
    assert {name: len(part) for name, part in by_source(outcomes["a"]).items()} == {
        "set 0": 3,
        "set 1": 3,
        "rendered": 6,
    }
    assert methods[0].streams == [FRAMES] * 12
    assert still_figures(outcomes["a"])["lost"] == 12
    assert len(given) == 20


def test_towns_are_the_same_in_every_run_and_have_every_label() -> None:
    (first, image), (_, other) = list(town_frames(2))
    ((again, same),) = list(town_frames(1))
    np.testing.assert_array_equal(image, same)
    assert image.shape != other.shape
    assert first.coverage == again.coverage == WHOLE
    outcomes = run_towns([Scripted("a", REPORTS)], 3)["a"]
    figures = town_figures(outcomes)
    assert figures["boundaries"]["all"]["frames"] == 3
    assert figures["reliability"]["ego"]["reports"] == 6


def test_verdicts_of_towns_stills_and_reliability() -> None:
    groups = town_figures([FrameEvaluation(ROAD, REPORTS)])
    kinds = {
        "false_markings": {name: {"frames": 0} for name in ("unmarked", "unpainted")},
        "road_edges": {"labeled": 0},
        "types": {"markings": 0, "confusion": {}},
        "colors": {"markings": 0, "confusion": {}},
    }
    still = StillOutcome("rendered", REPORTS, REPORTS[1:], WIDTH)
    lines = verdicts(
        {
            "methods": {"net": {}},
            "images": {"net": {"overall": {**groups, "kinds": kinds}}},
            "datasets": {"net": {}},
            "clips": {"net": {}},
            "no_road": {"net": {}},
            "towns": {"net": groups},
            "stills": {"net": {"overall": still_figures([still])}},
        }
    )
    assert "stills: a stream of one picture loses a boundary in 1 of 1, 1 of 4 boundaries" in lines
    certain = "what is reported with a probability of at least 0.9: 1 of 1 ego boundaries right (100 %)"
    assert f"rendered towns, {certain}" in lines
    assert f"single images, {certain}" in lines
    assert any(line.startswith("rendered towns: ego boundaries: 2 of 2 right") for line in lines)
