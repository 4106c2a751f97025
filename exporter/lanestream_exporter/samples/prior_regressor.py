"""Guides: regressors that show a classifier where to look, as in the service."""

from __future__ import annotations

from pathlib import Path

from lanestream.runtime import RuntimeOptions

from lanestream.detection.ego_prior import EgoPriorEstimator
from lanestream.engine import load_engine
from lanestream.errors import ModelError

_HINT = "give a regressor's ONNX file as the guide"


def prior_estimator(guide: Path) -> EgoPriorEstimator:
    """The glance by the regressor at `guide`, on one thread of the CPU. Raises ModelError where there is none."""
    if not guide.is_file():
        raise ModelError(f"can't read {guide}: no such file", _HINT)
    glance = load_engine(guide, "cpu", None, RuntimeOptions(threads=1)).pipeline().first_look
    if glance is None:
        raise ModelError(f"{guide} is not a regressor", _HINT)
    return glance
