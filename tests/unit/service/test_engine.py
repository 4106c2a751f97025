"""The engine: which detectors it builds from which models, and what it loads."""

from __future__ import annotations

from pathlib import Path

import fakes
import pytest

from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.detectors import DETECTORS
from lanestream.detection.regression_detector import RegressionDetector
from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR, Engine, load_engine, resolve_regressor
from lanestream.errors import ModelError, NoDetectorError
from lanestream.session import SessionOptions


def test_the_shipped_models_make_both_detectors() -> None:
    engine = load_engine(provider="cpu")
    assert list(engine.detectors) == [spec.name for spec in DETECTORS] == ["candidates", "regression"]
    candidates, regression = engine.detectors.values()
    assert isinstance(candidates, CandidateDetector)
    assert isinstance(regression, RegressionDetector)
    assert candidates.regressor == regression.regressor, "the regressor guides the search for candidates"
    assert engine.main_model() is engine.models["classifier"]
    assert engine.main_model("regression") is engine.models["regressor"]


def test_a_detector_without_its_model_is_left_out() -> None:
    engine = load_engine(provider="cpu")
    alone = Engine.of({"classifier": engine.models["classifier"]})
    assert list(alone.detectors) == ["candidates"]
    assert alone.detectors["candidates"].regressor is None  # type: ignore[attr-defined]
    assert list(Engine.of({"regressor": engine.models["regressor"]}).detectors) == ["regression"]


def test_the_first_detector_is_the_default_and_a_missing_one_is_an_error() -> None:
    engine = fakes.two_detectors()
    assert (engine.select(), engine.select("regression")) == ("candidates", "regression")
    for use in (engine.select, engine.main_model, lambda name: engine.open_session(SessionOptions(detector=name))):
        with pytest.raises(NoDetectorError, match="there is no detector other here") as error:
            use("other")
        assert error.value.hint == "ask for candidates, regression"


def test_a_processed_frame_has_the_time_of_its_inference() -> None:
    engine = fakes.engine()
    result = engine.process(engine.open_session(SessionOptions(single_image=True)), fakes.picture(), 0.0)
    assert set(result.timing_ms) == {"propose", "fit", "track", "infer"}
    assert len(result.lanes) == 2


def test_a_regressor_can_be_left_out_and_must_be_one(tmp_path: Path) -> None:
    assert list(load_engine(provider="cpu", regressor=None).detectors) == ["candidates"]
    assert list(load_engine(SHIPPED_REGRESSOR, "cpu").detectors) == ["regression"]
    with pytest.raises(ModelError, match=r"classifier.onnx is a classifier, not a regressor"):
        load_engine(provider="cpu", regressor=SHIPPED_MODEL)
    assert (resolve_regressor(None), resolve_regressor(Path("none"))) == (SHIPPED_REGRESSOR, None)
    assert resolve_regressor(tmp_path) == tmp_path
