"""What a boundary is, accumulated over frames: sure after some, followed if it changes, forgotten if it is hidden."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanestream.road.appearance import MARKING_COLORS, MARKING_TYPES, Appearance
from lanestream.tracking.appearance import accumulated, as_saved, forgotten

DT = 0.04
EVEN = (0.25,) * 4


def seen(kind: str, color: str = "white", sure: float = 0.85) -> Appearance:
    """Returns how a boundary of this type, or a `road_edge`, looks in a frame to a network that is this `sure`."""
    if kind == "road_edge":
        return Appearance(sure, EVEN, (0.5, 0.5))
    types = tuple(sure if name == kind else (1.0 - sure) / 3.0 for name in MARKING_TYPES)
    colors = tuple(sure if name == color else 1.0 - sure for name in MARKING_COLORS)
    return Appearance(1.0 - sure, types, colors)


def best(appearance: Appearance) -> tuple[str, str, str]:
    """Returns the most probable kind, type and color."""
    assert appearance.types is not None
    assert appearance.colors is not None
    return (
        appearance.kind,
        MARKING_TYPES[appearance.types.index(max(appearance.types))],
        MARKING_COLORS[appearance.colors.index(max(appearance.colors))],
    )


def after(frames: int, one: Appearance, past: Appearance | None = None, dt: float = DT) -> Appearance:
    """Returns what is known after so many frames that all show `one`."""
    known = accumulated(Appearance(), one, math.inf, 1.0) if past is None else past
    for _ in range(frames):
        known = as_saved(accumulated(known, one, dt, 1.0))
    return known


def test_frames_make_sure() -> None:
    one, many = after(0, seen("dashed", "yellow")), after(50, seen("dashed", "yellow"))
    assert best(one) == best(many) == ("marking", "dashed", "yellow")
    assert one.types is not None
    assert 0.75 < one.types[1] < 0.85, "as sure as the network, but for the chance that it is a road edge"
    assert many.types is not None
    assert many.types[1] > 0.97
    assert many.colors is not None
    assert many.colors[1] > 0.97
    assert many.road_edge < 0.02


def test_neighboring_frames_count_less_than_frames_far_apart() -> None:
    ten_at_once = after(10, seen("dashed", sure=0.5), dt=DT)
    ten_far_apart = after(10, seen("dashed", sure=0.5), dt=0.5)
    assert ten_at_once.types is not None
    assert ten_far_apart.types is not None
    assert ten_at_once.types[1] + 0.1 < ten_far_apart.types[1]


@pytest.mark.parametrize("sure", [0.7, 0.85, 0.99])
def test_a_line_that_becomes_solid_is_followed_within_about_a_second(sure: float) -> None:
    known, frames = after(250, seen("dashed", sure=sure)), 0
    while best(known)[1] != "solid":
        known, frames = after(1, seen("solid", sure=sure), known), frames + 1
    assert 5 <= frames <= 27
    assert best(after(frames + 15, seen("solid", sure=sure), after(250, seen("dashed", sure=sure))))[1] == "solid"


def test_a_kind_changes_more_slowly_than_a_type() -> None:
    changed = after(12, seen("road_edge"), after(250, seen("dashed")))
    assert changed.kind == "marking"
    assert after(40, seen("road_edge"), changed).kind == "road_edge"


def test_single_wrong_frames_change_nothing() -> None:
    known = after(50, seen("dashed", "yellow"))
    for i in range(200):
        wrong = (seen("road_edge", sure=0.999), seen("solid", "white", 0.999))[i // 5 % 2]
        known = as_saved(accumulated(known, wrong if i % 5 == 0 else seen("dashed", "yellow"), DT, 1.0))
        assert best(known) == ("marking", "dashed", "yellow")


def test_without_paint_nothing_is_learned_of_type_and_color() -> None:
    before = after(50, seen("dashed", "yellow"))
    known, expected = before, forgotten(before, 1.0)
    for _ in range(25):
        known = accumulated(known, seen("solid", "white", 0.99), DT, 0.0)
    assert known.types == pytest.approx(expected.types, abs=1e-3)
    assert known.colors == pytest.approx(expected.colors, abs=1e-3)
    assert accumulated(before, seen("road_edge", sure=1.0), DT, 1.0).types == pytest.approx(
        forgotten(before, DT).types, abs=1e-3
    )


def test_a_boundary_that_is_not_seen_is_forgotten() -> None:
    known = after(50, seen("dashed", "yellow"))
    shares = [forgotten(known, seconds) for seconds in (0.0, 1.0, 5.0, math.inf)]
    types = [max(share.types or ()) for share in shares]
    assert types == sorted(types, reverse=True)
    assert shares[0] == known
    assert shares[-1] == Appearance(0.5, EVEN, (0.5, 0.5))


def test_a_model_that_does_not_classify_markings_leaves_type_and_color_unknown() -> None:
    known = after(50, Appearance())
    assert (known.kind, known.types, known.colors) == ("marking", None, None)
    assert known.road_edge < 0.01
    classified = after(5, seen("dashed"))
    assert accumulated(classified, Appearance(), 0.0, 1.0) == classified


PROBABILITIES = st.floats(0.0, 1.0)


@st.composite
def appearances(draw: st.DrawFn) -> Appearance:
    types = [draw(PROBABILITIES) + 1e-9 for _ in MARKING_TYPES]
    colors = [draw(PROBABILITIES) + 1e-9 for _ in MARKING_COLORS]
    return Appearance(draw(PROBABILITIES), tuple(p / sum(types) for p in types), tuple(p / sum(colors) for p in colors))


@given(appearances(), appearances(), st.floats(0.0, 1e15) | st.just(math.inf), PROBABILITIES)
def test_results_are_probabilities(past: Appearance, one: Appearance, seconds: float, paint: float) -> None:
    known = accumulated(past, one, seconds, paint)
    assert known.types is not None
    assert known.colors is not None
    for probabilities in ((known.road_edge,), known.types, known.colors):
        assert all(0.0 <= p <= 1.0 for p in probabilities)
    assert sum(known.types) == pytest.approx(1.0)
    assert sum(known.colors) == pytest.approx(1.0)
    assert as_saved(as_saved(known)) == as_saved(known)
