"""The regressor whose ego-lane prior the candidate search uses, as in the service."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.ego_prior import RoadRegressor
from lanestream.detection.interface import ModelRole
from lanestream.errors import ModelError
from lanestream.inference.loaded_model import LoadedModel
from lanestream.inference.loading import load_model
from lanestream.inference.model_info import RegressorInfo
from lanestream.inference.providers import RuntimeOptions

_HINT = "give a regressor's ONNX file"


@dataclass(frozen=True)
class PriorRegressor:
    """A regressor as detectors use it: `regressor` prepares inputs and reads outputs, `model` runs."""

    regressor: RoadRegressor
    model: LoadedModel

    def infer(self, role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns the model's outputs; `role` must be `regressor`."""
        assert role == "regressor"  # noqa: S101 - proposals need no other network
        return self.model.run(inputs)


def load_prior_regressor(path: Path) -> PriorRegressor:
    """Loads the regressor in the ONNX file at `path` on one CPU thread. Raises ModelError for other files."""
    if not path.is_file():
        raise ModelError(f"can't read {path}: no such file", _HINT)
    model = load_model(path, "cpu", RuntimeOptions(threads=1))
    if not isinstance(model.info, RegressorInfo):
        raise ModelError(f"{path} is not a regressor", _HINT)
    return PriorRegressor(RoadRegressor(model.info.threshold, model.info.road_crop), model)


def no_regressor(role: ModelRole, _inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Stands for `infer` in a search without a prior, which runs no network. Raises AssertionError."""
    raise AssertionError(f"no {role} is loaded")
