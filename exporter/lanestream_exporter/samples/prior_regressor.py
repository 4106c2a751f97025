"""The regressor whose ego-lane prior the candidate search uses, as in the service."""

from __future__ import annotations

from pathlib import Path

from lanestream.detection.ego_prior import EgoPriorEstimator
from lanestream.engine import load_engine
from lanestream.errors import ModelError
from lanestream.runtime import RuntimeOptions

_HINT = "give a regressor's ONNX file"


def prior_estimator(regressor: Path) -> EgoPriorEstimator:
    """Returns the ego-lane prior of the ONNX file `regressor`, on one CPU thread. Raises ModelError for other files."""
    if not regressor.is_file():
        raise ModelError(f"can't read {regressor}: no such file", _HINT)
    estimator = load_engine(regressor, "cpu", None, RuntimeOptions(threads=1)).pipeline().first_look
    if estimator is None:
        raise ModelError(f"{regressor} is not a regressor", _HINT)
    return estimator
