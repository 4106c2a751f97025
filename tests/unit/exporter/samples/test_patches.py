"""Verdicts on candidates, matching of boundaries and labels, and patch files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lanestream.errors import LabelError
from lanestream.road.curve import Curve, Curves
from lanestream.road.view import RoadView, Scaling, Spans
from lanestream_exporter.datasets.clips import read_clip_labels
from lanestream_exporter.datasets.labels import EGO_LANE, PARTIAL, WHOLE, Coverage, LabeledFrame, LabeledLane
from lanestream_exporter.evaluation.boundaries import ReportedBoundary, ego_labels, match
from lanestream_exporter.evaluation.score import BoundaryCounts
from lanestream_exporter.samples.patch_files import read_stores, write_store
from lanestream_exporter.samples.patches import FALSE, TRUE, UNKNOWN, UNSURE, TruthRule, fitted_candidate

VIEW = RoadView(1280, 720, 300.0)


def curve(b: float, v: float = 640.0) -> Curve:
    return Curve(300.0, (v, b, 0.0))


def label(b: float, top: float = 340.0, bottom: float = 700.0, position: int | None = None) -> LabeledLane:
    rows = np.linspace(bottom, top, 30)
    return LabeledLane(np.stack([curve(b).x(rows), rows], axis=1), position=position)


def frame(*lanes: LabeledLane, coverage: Coverage = PARTIAL) -> LabeledFrame:
    return LabeledFrame(1280, 720, lanes, "clip", "clip#0", coverage)


def judge(*curves: Curve, labels: LabeledFrame, top: float = 342.0) -> list[int]:
    """Returns the verdicts on candidates that are visible from the row `top` down."""
    number = len(curves)
    spans = Spans(np.full(number, top), np.full(number, 719.0), np.ones(number, bool))
    return TruthRule().judge(Curves.of(curves), spans, VIEW, labels).tolist()


@pytest.mark.parametrize(
    ("b", "v", "verdict"),
    [
        (-1.1, 640.0, TRUE),
        (-1.1, 650.0, TRUE),
        (-1.1, 668.0, UNSURE),
        (0.0, 640.0, FALSE),
        (2.5, 640.0, UNKNOWN),
        (-2.5, 640.0, UNKNOWN),
    ],
)
def test_verdicts(b: float, v: float, verdict: int) -> None:
    assert judge(curve(b, v), labels=frame(label(-1.1), label(1.1))) == [verdict]


def test_verdicts_do_not_depend_on_the_size_of_the_frame() -> None:
    labels = frame(label(-1.1), label(1.1))
    scaling = Scaling.to_working_width(1280)
    working = labels.at_working_width
    assert (working.width, working.height) == (640, 360)
    view = RoadView(640, 360, scaling.to_working(VIEW.horizon))
    places = (640.0, 650.0, 668.0, 720.0)
    curves = Curves.of([scaling.curve_to_working(curve(-1.1, v)) for v in places])
    spans = Spans(np.full(4, scaling.to_working(342.0)), np.full(4, 359.0), np.ones(4, bool))
    verdicts = TruthRule().judge(curves, spans, view, working).tolist()
    assert verdicts == judge(*(curve(-1.1, v) for v in places), labels=labels) == [TRUE, TRUE, UNSURE, FALSE]


def test_beyond_the_labels_of_a_completely_labeled_frame_a_candidate_is_false() -> None:
    labels = frame(label(-1.1), label(1.1), coverage=WHOLE)
    assert judge(curve(2.5), labels=labels) == [FALSE]


@pytest.mark.parametrize(
    ("coverage", "verdicts"),
    [
        (EGO_LANE, [UNKNOWN, UNKNOWN]),
        (Coverage(open_sides=(1,)), [FALSE, UNKNOWN]),
        (Coverage(open_sides=(-1,)), [UNKNOWN, FALSE]),
    ],
)
def test_beyond_the_labels_a_candidate_is_unknown_if_the_side_is_open(coverage: Coverage, verdicts: list[int]) -> None:
    labels = frame(label(-1.1, position=-1), label(1.1, position=1), coverage=coverage)
    assert judge(curve(-2.5), curve(2.5), labels=labels) == verdicts
    for b, verdict in zip((-2.5, 2.5), verdicts, strict=True):
        tally = BoundaryCounts()
        tally.add(match([found(b)], labels.lanes, labels))
        assert tally.wrong == (verdict == FALSE)


def test_beyond_an_absent_ego_boundary_a_candidate_is_false() -> None:
    labels = frame(label(1.1, position=1), coverage=EGO_LANE)
    assert judge(curve(-2.5), curve(2.5), labels=labels) == [FALSE, UNKNOWN]


def test_a_short_overlap_is_not_enough_to_be_true() -> None:
    assert judge(curve(-1.1), labels=frame(label(-1.1)), top=600.0) == [UNSURE]


def test_a_label_becomes_the_candidate_that_follows_it() -> None:
    curved = Curve(300.0, (640.0, -1.1, 4000.0))
    rows = np.linspace(700.0, 340.0, 30)
    fitted = fitted_candidate(LabeledLane(np.stack([curved.x(rows), rows], axis=1)), VIEW)
    assert fitted is not None
    np.testing.assert_allclose(fitted.x(rows), curved.x(rows), atol=0.01)


def found(b: float, v: float = 640.0, top: float = 342.0, position: int = -1) -> ReportedBoundary:
    return ReportedBoundary(curve(b, v), top, 719.0, position)


def test_boundaries_are_matched_one_to_one() -> None:
    tally = BoundaryCounts()
    tally.add(match([found(-1.1), found(-1.1, 635.0)], [label(-1.1)], frame(label(-1.1), label(1.1))))
    assert (tally.right, tally.wrong, tally.missed) == (1, 1, 0)  # the second repeats the outermost label
    tally = BoundaryCounts()
    tally.add(match([found(-1.1), found(-3.3)], [label(-1.1)], frame(label(-1.1), label(1.1))))
    assert (tally.right, tally.wrong, tally.missed) == (1, 0, 0)  # the second lies beyond it and is unknown
    tally = BoundaryCounts()
    tally.add(match([found(-1.1), found(-1.1, 645.0)], [label(-1.1)], frame(label(-1.1), coverage=WHOLE)))
    assert (tally.right, tally.wrong, tally.missed) == (1, 1, 0)
    assert tally.errors == pytest.approx([0.0], abs=1e-9)


def test_distant_or_short_boundaries_are_wrong_and_the_label_is_missed() -> None:
    for wrong in (found(-1.1, 700.0), found(-1.1, top=600.0)):
        tally = BoundaryCounts()
        tally.add(match([wrong], [label(-1.1)], frame(label(-1.1), coverage=WHOLE)))
        assert (tally.right, tally.wrong, tally.missed) == (0, 1, 1)


def test_errors_are_in_pixels_of_a_640_pixel_wide_image() -> None:
    tally = BoundaryCounts()
    tally.add(match([found(0.0, 650.0)], [label(0.0)], frame(label(0.0), coverage=WHOLE)))
    assert tally.mean_error == pytest.approx(5.0)


def test_ego_labels_without_positions_are_the_nearest_to_the_camera() -> None:
    lanes = [label(-3.3), label(-1.1), label(1.1), label(3.3, bottom=450.0)]
    assert ego_labels(frame(*lanes)) == lanes[1:3]
    positioned = [label(-3.3, position=-1), label(-1.1, position=2)]
    assert ego_labels(frame(*positioned)) == positioned[:1]


def test_a_bad_label_record_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "clip.jsonl"
    path.write_text('{"frame": 0, "width": 10, "height": 10, "lanes": []}\n{"frame": 1}\n')
    with pytest.raises(LabelError, match=r"clip\.jsonl:2: .*lanes|width"):
        read_clip_labels(path)


def test_patches_survive_the_store(tmp_path: Path) -> None:
    patches = [np.full((224, 224, 3), (200, 20, level), np.uint8) for level in (0, 100, 200)]
    for name, labels in (("a", [0, 1]), ("b", [1])):
        write_store(tmp_path / f"{name}.npz", zip(patches[-len(labels) :], labels, strict=True))
    store = read_stores([tmp_path / "a.npz", tmp_path / "b.npz"])
    assert store.labels.tolist() == [0, 1, 1]
    for index, expected in enumerate((patches[1], patches[2], patches[2])):
        np.testing.assert_allclose(store.patch(index), expected, atol=6)


def test_a_broken_store_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "broken.npz"
    path.write_text("no patches")
    with pytest.raises(LabelError, match=r"broken\.npz"):
        read_stores([path])
