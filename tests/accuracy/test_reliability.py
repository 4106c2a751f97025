"""What the shipped networks report in towns is as reliable as they say, and a stream of one picture keeps it."""

from __future__ import annotations

import pytest

from lanestream.engine import load_engine
from lanestream_exporter.evaluation.methods import ServedModel
from lanestream_exporter.evaluation.reliability import ROLES, reliability_figures
from lanestream_exporter.evaluation.stills import run_stills, still_figures
from lanestream_exporter.evaluation.towns import run_towns

LEAST_RIGHT = 0.9
MOST_WITH_LOSS = 1


@pytest.fixture(scope="module")
def method() -> ServedModel:
    return ServedModel(load_engine(provider="cpu"))


def test_of_what_is_reported_with_a_probability_of_0_9_nine_in_ten_are_right(method: ServedModel) -> None:
    figures = reliability_figures(run_towns([method], 60)[method.name])
    for role in ROLES:
        row = next(row for row in figures[role]["trade"] if row["least"] == LEAST_RIGHT)
        assert row["right"] >= 20
        assert row["precision"] >= LEAST_RIGHT, role


def test_a_stream_of_one_picture_keeps_what_the_single_picture_shows(method: ServedModel) -> None:
    figures = still_figures(run_stills([method], iter(()), [], 24)[method.name])
    assert figures["stills"] == 24
    assert figures["boundaries"] >= 48
    assert figures["with_loss"] <= MOST_WITH_LOSS, figures
