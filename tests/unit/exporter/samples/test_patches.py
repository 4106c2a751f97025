"""What candidates are by their labels, matching of boundaries and labels, and patch files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import roads

from lanestream.errors import LabelError
from lanestream.road.appearance import MARKING_COLORS, MARKING_TYPES
from lanestream.road.crops import PatchGeometry
from lanestream.road.curve import Curve, Curves
from lanestream.road.view import Image, RoadView, Scaling, Spans
from lanestream_exporter.datasets.clips import read_clip_labels
from lanestream_exporter.datasets.labels import EGO_LANE, PARTIAL, WHOLE, Coverage, LabeledFrame, LabeledLane
from lanestream_exporter.evaluation.boundaries import ReportedBoundary, ego_labels, match
from lanestream_exporter.evaluation.score import BoundaryCounts
from lanestream_exporter.samples.patch_files import read_stores, write_store
from lanestream_exporter.samples.patches import NOT_KNOWN, Patches, PatchMaker
from lanestream_exporter.samples.truth import (
    MARKING,
    NOTHING,
    ROAD_EDGE,
    UNKNOWN,
    UNSURE,
    TruthRule,
    Verdicts,
    fitted_candidate,
)

VIEW = RoadView(1280, 720, 300.0)


def curve(b: float, v: float = 640.0) -> Curve:
    return Curve(300.0, (v, b, 0.0))


def label(
    b: float,
    top: float = 340.0,
    bottom: float = 700.0,
    position: int | None = None,
    of_type: str | None = "solid",
    color: str | None = None,
) -> LabeledLane:
    rows = np.linspace(bottom, top, 30)
    return LabeledLane(np.stack([curve(b).x(rows), rows], axis=1), position=position, type=of_type, color=color)


def frame(*lanes: LabeledLane, coverage: Coverage = PARTIAL) -> LabeledFrame:
    return LabeledFrame(1280, 720, lanes, "clip", "clip#0", coverage)


def verdicts_on(*curves: Curve, labels: LabeledFrame, top: float = 342.0) -> Verdicts:
    """Returns the verdicts on candidates that are visible from the row `top` down."""
    number = len(curves)
    spans = Spans(np.full(number, top), np.full(number, 719.0), np.ones(number, bool))
    return TruthRule().judge(Curves.of(curves), spans, VIEW, labels)


def judge(*curves: Curve, labels: LabeledFrame, top: float = 342.0) -> list[int]:
    """Returns what candidates that are visible from the row `top` down may be."""
    kinds: list[int] = verdicts_on(*curves, labels=labels, top=top).kinds.tolist()
    return kinds


@pytest.mark.parametrize(
    ("b", "v", "verdict"),
    [
        (-1.1, 640.0, MARKING),
        (-1.1, 650.0, MARKING),
        (-1.1, 668.0, UNSURE),
        (0.0, 640.0, NOTHING),
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
    kinds = TruthRule().judge(curves, spans, view, working).kinds.tolist()
    expected = [MARKING, MARKING, UNSURE, NOTHING]
    assert kinds == judge(*(curve(-1.1, v) for v in places), labels=labels) == expected


def test_beyond_the_labels_of_a_completely_labeled_frame_a_candidate_is_nothing() -> None:
    labels = frame(label(-1.1), label(1.1), coverage=WHOLE)
    assert judge(curve(2.5), labels=labels) == [NOTHING]


def test_beyond_the_labels_a_candidate_may_be_an_edge_that_is_not_labeled() -> None:
    closed, with_edges = Coverage(open_sides=()), Coverage(open_sides=(), edges=True)
    for coverage, beyond in ((closed, NOTHING | ROAD_EDGE), (with_edges, NOTHING)):
        labels = frame(label(-1.1), label(1.1), coverage=coverage)
        assert judge(curve(-2.5), curve(0.0), curve(2.5), labels=labels) == [beyond, NOTHING, beyond]


@pytest.mark.parametrize("open_sides", [(), (1,), (-1, 1)])
@pytest.mark.parametrize("edges", [False, True])
def test_in_a_frame_without_markings_nothing_is_one(open_sides: tuple[int, ...], edges: bool) -> None:
    painted, bare = (Coverage(open_sides=open_sides, edges=edges, markings=markings) for markings in (True, False))
    lanes = label(-1.1, of_type="edge"), label(1.1, of_type="kerb")
    candidates = [curve(b) for b in (-2.5, 0.0, 1.1, 2.5)]
    with_markings, without = (judge(*candidates, labels=frame(*lanes, coverage=each)) for each in (painted, bare))
    assert without == [kinds & ~MARKING for kinds in with_markings]
    assert without[1:3] == [NOTHING, ROAD_EDGE]
    assert bool(with_markings[3] & MARKING) == (1 in open_sides)


@pytest.mark.parametrize(
    ("of_type", "color", "kinds"),
    [
        ("solid", None, MARKING),
        (None, "yellow", MARKING),
        ("kerb", None, ROAD_EDGE),
        ("edge", None, ROAD_EDGE),
        (None, None, MARKING | ROAD_EDGE),
    ],
)
def test_a_candidate_has_the_kind_of_the_label_that_it_follows(
    of_type: str | None, color: str | None, kinds: int
) -> None:
    labels = frame(label(-1.1), label(1.1, of_type=of_type, color=color))
    verdicts = verdicts_on(curve(1.1), curve(0.0), labels=labels)
    assert verdicts.kinds.tolist() == [kinds, NOTHING]
    assert verdicts.labels.tolist() == [1, -1]
    assert verdicts.is_true.tolist() == [True, False]
    assert verdicts.is_false.tolist() == [False, True]


def test_of_a_marking_and_an_edge_beside_it_a_candidate_follows_the_nearer() -> None:
    # 0.4 m apart before a camera 1.4 m high.
    marking, edge = 1.1, 1.1 + 0.4 / 1.4
    for lanes in ((label(marking), label(edge, of_type="kerb")), (label(edge, of_type="kerb"), label(marking))):
        labels = frame(label(-1.1), *lanes, coverage=WHOLE)
        verdicts = verdicts_on(curve(marking), curve(marking + 0.02), curve(edge - 0.02), curve(edge), labels=labels)
        assert verdicts.kinds.tolist() == [MARKING, MARKING, ROAD_EDGE, ROAD_EDGE]
        followed = [labels.lanes[index].type for index in verdicts.labels.tolist()]
        assert followed == ["solid", "solid", "kerb", "kerb"]


def test_between_labels_on_one_line_a_candidate_follows_the_nearest() -> None:
    # Closer to each other than a candidate may be to its label.
    lanes = label(1.1), label(1.13, of_type="kerb")
    for order in (lanes, lanes[::-1]):
        assert judge(curve(1.11), curve(1.12), labels=frame(*order)) == [MARKING, ROAD_EDGE]


@pytest.mark.parametrize(
    ("coverage", "verdicts"),
    [
        (EGO_LANE, [UNKNOWN, UNKNOWN]),
        (Coverage(open_sides=(1,), edges=True), [NOTHING, UNKNOWN]),
        (Coverage(open_sides=(-1,), edges=True), [UNKNOWN, NOTHING]),
    ],
)
def test_beyond_the_labels_a_candidate_is_unknown_if_the_side_is_open(coverage: Coverage, verdicts: list[int]) -> None:
    labels = frame(label(-1.1, position=-1), label(1.1, position=1), coverage=coverage)
    assert judge(curve(-2.5), curve(2.5), labels=labels) == verdicts
    for b, verdict in zip((-2.5, 2.5), verdicts, strict=True):
        tally = BoundaryCounts()
        tally.add(match([found(b)], labels.lanes, labels))
        assert tally.wrong == (verdict == NOTHING)


def test_beyond_an_absent_ego_boundary_a_candidate_is_no_marking() -> None:
    labels = frame(label(1.1, position=1), coverage=EGO_LANE)
    assert judge(curve(-2.5), curve(2.5), labels=labels) == [NOTHING | ROAD_EDGE, UNKNOWN]


def test_a_short_overlap_is_not_enough_to_follow_a_label() -> None:
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


def batch(*targets: tuple[int, int, int], level: int = 0) -> Patches:
    """Returns patches of one color with these targets."""
    pixels = np.full((len(targets), 224, 224, 3), (200, 20, level), np.uint8)
    return Patches(pixels, np.array(targets, np.int8).reshape(-1, 3))


def test_patches_survive_the_store(tmp_path: Path) -> None:
    first, second, third = batch((NOTHING, -1, -1)), batch((MARKING, 1, 0), level=100), batch((ROAD_EDGE, -1, -1))
    write_store(tmp_path / "a.npz", [("one", first), ("two", second)])
    write_store(tmp_path / "b.npz", [("two", third), ("empty", batch()), ("three", first)])
    store = read_stores([tmp_path / "a.npz", tmp_path / "b.npz"])
    assert len(store) == 4
    assert store.targets.tolist() == [[NOTHING, -1, -1], [MARKING, 1, 0], [ROAD_EDGE, -1, -1], [NOTHING, -1, -1]]
    assert [store.names[index] for index in store.sets.tolist()] == ["one", "two", "two", "three"]
    for index, level in enumerate((0, 100, 0, 0)):
        np.testing.assert_allclose(store.patch(index), np.full((224, 224, 3), (200, 20, level)), atol=6)


def test_a_store_may_be_empty(tmp_path: Path) -> None:
    assert write_store(tmp_path / "none.npz", []) == 0
    assert len(read_stores([tmp_path / "none.npz"])) == 0


def test_known_patches_teach_something() -> None:
    every = [(kinds, -1, -1) for kinds in range(8)]
    known = batch(*every).known
    assert known.targets[:, 0].tolist() == [1, 2, 3, 4, 5, 6]
    assert len(known.pixels) == 6


# --- Patches of a frame ---------------------------------------------------------------------------------------------


def drawn_frame() -> tuple[Image, LabeledFrame]:
    """Returns a road with a dashed yellow marking, one of which nothing is known, and an edge; and its labels."""
    view = RoadView(640, 360, 150.0)
    image = roads.draw_surfaces(view, [roads.straight(view, 2.0)], [(90, 90, 90), (45, 100, 80)])
    image = roads.paint_on(image, view, [roads.straight(view, position) for position in (-1.1, 1.1)])
    rows = np.linspace(350.0, 170.0, 30)

    def lane(position: float, of_type: str | None, color: str | None) -> LabeledLane:
        return LabeledLane(np.stack([roads.straight(view, position).x(rows), rows], axis=1), type=of_type, color=color)

    lanes = lane(-1.1, "dashed", "yellow"), lane(1.1, None, None), lane(2.0, "edge", None)
    return image, LabeledFrame(640, 360, lanes, "drive", "drawn", WHOLE, horizon=150.0)


def test_targets_are_what_a_patch_may_show_and_the_type_and_color_of_its_marking() -> None:
    image, labels = drawn_frame()
    maker = PatchMaker(PatchGeometry(64))
    for patches in (
        maker.proposed(image, labels, maker.propose(image)),
        maker.jittered(image, labels, RoadView(640, 360, 150.0), np.random.default_rng(0)),
    ):
        assert len(patches.pixels) == len(patches.targets)
        dashed, yellow = MARKING_TYPES.index("dashed"), MARKING_COLORS.index("yellow")
        found = set(map(tuple, patches.targets.tolist()))
        assert {(MARKING, dashed, yellow), (MARKING | ROAD_EDGE, NOT_KNOWN, NOT_KNOWN)} <= found
        assert {kinds for kinds, *_ in found} - {NOTHING, UNSURE} == {MARKING, MARKING | ROAD_EDGE, ROAD_EDGE}
        assert {each for each in found if each[0] != MARKING} <= {
            (kinds, NOT_KNOWN, NOT_KNOWN) for kinds in (NOTHING, UNSURE, ROAD_EDGE, MARKING | ROAD_EDGE)
        }


def test_a_broken_store_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "broken.npz"
    path.write_text("no patches")
    with pytest.raises(LabelError, match=r"broken\.npz"):
        read_stores([path])
