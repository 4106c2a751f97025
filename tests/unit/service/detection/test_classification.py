"""The classifier's outputs: how they are read, what a prior does to them, and how boundaries look by them."""

from __future__ import annotations

import numpy as np
import pytest

from lanestream.detection.classification import Classification
from lanestream.road.appearance import Appearance

# Nothing, marking and road edge; solid, dashed, double and dots; white and yellow.
OUTPUTS = np.array(
    [
        [0.1, 0.7, 0.2, 0.6, 0.3, 0.1, 0.0, 0.9, 0.1],
        [0.5, 0.1, 0.4, 0.2, 0.2, 0.2, 0.4, 0.3, 0.7],
    ],
    np.float32,
)


def test_nine_outputs_are_kinds_types_and_colors() -> None:
    found = Classification.of(OUTPUTS)
    assert found.kinds == pytest.approx(np.array([[0.7, 0.2], [0.1, 0.4]]))
    assert found.types == pytest.approx(OUTPUTS[:, 3:7])
    assert found.colors == pytest.approx(OUTPUTS[:, 7:])
    assert found.boundary == pytest.approx([0.9, 0.5])


def test_two_outputs_of_an_older_network_are_nothing_and_a_marking() -> None:
    found = Classification.of(np.array([[0.3, 0.7], [0.9, 0.1]], np.float32))
    assert found.kinds == pytest.approx(np.array([[0.7, 0.0], [0.1, 0.0]]))
    assert (found.types, found.colors) == (None, None)
    assert found.boundary == pytest.approx([0.7, 0.1])
    assert found.appearances(np.eye(2)) == [Appearance(), Appearance()]
    (taken,) = found.take(np.array([1])).appearances(np.ones((1, 1)))
    assert taken == Appearance()


def test_candidates_are_taken_with_their_types_and_colors() -> None:
    taken = Classification.of(OUTPUTS).take(np.array([1]))
    assert taken.types is not None
    assert taken.colors is not None
    assert taken.kinds == pytest.approx(np.array([[0.1, 0.4]]))
    assert taken.types[0] == pytest.approx(OUTPUTS[1, 3:7])
    assert taken.colors[0] == pytest.approx(OUTPUTS[1, 7:])


def test_odds_change_probabilities_by_the_rule_of_bayes() -> None:
    odds = np.array([[3.0, 0.5], [0.2, 8.0]])
    found = Classification.of(OUTPUTS).with_odds(odds)
    for i in range(2):
        nothing, marking, edge = OUTPUTS[i, :3].astype(float)
        evidence = nothing + marking * odds[i, 0] + edge * odds[i, 1]
        assert found.kinds[i] == pytest.approx([marking * odds[i, 0] / evidence, edge * odds[i, 1] / evidence])
        assert 1.0 - found.boundary[i] == pytest.approx(nothing / evidence)
    assert found.types == pytest.approx(OUTPUTS[:, 3:7])
    assert found.colors == pytest.approx(OUTPUTS[:, 7:])


def test_odds_of_one_change_nothing_and_certain_outputs_stay_finite() -> None:
    found = Classification.of(OUTPUTS)
    assert found.with_odds(np.ones((2, 2))).kinds == pytest.approx(found.kinds)
    certain = Classification(np.array([[1.0, 0.0], [0.0, 0.0]])).with_odds(np.array([[0.0, 1.0], [9.0, 9.0]]))
    assert certain.kinds == pytest.approx(np.zeros((2, 2)))


def test_the_appearance_of_a_boundary_is_the_weighted_mean_of_its_candidates() -> None:
    first, second, mixed = Classification.of(OUTPUTS).appearances(np.array([[2.0, 0.0], [0.0, 1.0], [3.0, 1.0]]))
    assert (first.kind, second.kind) == ("marking", "road_edge")
    assert first.road_edge == pytest.approx(0.2 / 0.9)
    assert second.road_edge == pytest.approx(0.4 / 0.5)
    marking, edge = 0.75 * 0.7 + 0.25 * 0.1, 0.75 * 0.2 + 0.25 * 0.4
    assert mixed.road_edge == pytest.approx(edge / (marking + edge))
    assert mixed.types == pytest.approx(0.75 * OUTPUTS[0, 3:7] + 0.25 * OUTPUTS[1, 3:7])
    assert mixed.colors == pytest.approx(0.75 * OUTPUTS[0, 7:] + 0.25 * OUTPUTS[1, 7:])
