"""The shipped models report nothing in pictures that show no road."""

from __future__ import annotations

import pytest

from lanestream.engine import SHIPPED_MODEL, load_engine
from lanestream_exporter.evaluation.methods import ServedModel
from lanestream_exporter.evaluation.no_road import no_road_figures, run_no_road

MOST_WITH_BOUNDARY = 0.05


@pytest.mark.parametrize("file", ["classifier.onnx", "regressor.onnx"])
def test_hardly_any_picture_without_a_road_gets_a_boundary(file: str) -> None:
    method = ServedModel(load_engine(SHIPPED_MODEL.with_name(file), "cpu"))
    figures = no_road_figures(run_no_road([method], 200)[method.name])
    assert figures["pictures"] == 200
    assert figures["share"] <= MOST_WITH_BOUNDARY, figures
