"""The engine of a process: its loaded models, and the detectors that use them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.detectors import DETECTORS, ModelDescriptions
from lanestream.detection.interface import Detector, ModelRole
from lanestream.errors import ModelError, NoDetectorError
from lanestream.host import keep_freed_memory
from lanestream.inference.loaded_model import LoadedModel
from lanestream.inference.loading import load_model
from lanestream.inference.model_info import ClassifierInfo, RegressorInfo
from lanestream.inference.providers import AUTO, DEFAULT_OPTIONS, RuntimeOptions
from lanestream.road.results import FrameResult
from lanestream.road.view import Image
from lanestream.session import DEFAULT_SESSION, Session, SessionOptions
from lanestream.tracking.departure import UNKNOWN_MOTION, VehicleMotion

# The shipped networks, which are the default.
SHIPPED_MODEL: Final = Path(__file__).parent / "models" / "classifier.onnx"
SHIPPED_REGRESSOR: Final = Path(__file__).parent / "models" / "regressor.onnx"
# The names that stand for these files and for no regressor, where a user gives a path.
_SHIPPED: Final = Path("shipped")
_NONE: Final = Path("none")


@dataclass(frozen=True)
class Engine:
    """The models of a process by their roles and the detectors by their names, shared by all its sessions.

    `main_roles` names the model that each detector requires. The first detector is the default.
    """

    models: Mapping[ModelRole, LoadedModel]
    detectors: Mapping[str, Detector]
    main_roles: Mapping[str, ModelRole]

    @classmethod
    def of(cls, models: Mapping[ModelRole, LoadedModel]) -> Engine:
        """Returns the engine with every detector that the `models` allow."""
        infos = {role: model.info for role, model in models.items()}
        classifier, regressor = infos.get("classifier"), infos.get("regressor")
        descriptions = ModelDescriptions(
            classifier if isinstance(classifier, ClassifierInfo) else None,
            regressor if isinstance(regressor, RegressorInfo) else None,
        )
        built = {spec.name: spec.build(descriptions) for spec in DETECTORS}
        detectors = {name: detector for name, detector in built.items() if detector is not None}
        return cls(models, detectors, {spec.name: spec.model for spec in DETECTORS if spec.name in detectors})

    def select(self, name: str | None = None) -> str:
        """Returns the name of the detector `name`, or of the default one. Raises NoDetectorError if it is missing."""
        if name is None:
            return next(iter(self.detectors))
        if name not in self.detectors:
            raise NoDetectorError(f"there is no detector {name} here", f"ask for {', '.join(self.detectors)}")
        return name

    def main_model(self, detector: str | None = None) -> LoadedModel:
        """Returns the model that `detector`, or the default one, requires. Raises NoDetectorError if missing."""
        return self.models[self.main_roles[self.select(detector)]]

    def open_session(self, options: SessionOptions = DEFAULT_SESSION) -> Session:
        """Returns a session for one camera. Raises NoDetectorError if its detector is not loaded."""
        return Session(self.detectors[self.select(options.detector)], options)

    def process(
        self,
        session: Session,
        image: Image,
        timestamp: float,
        motion: VehicleMotion = UNKNOWN_MOTION,
        size: tuple[int, int] | None = None,
    ) -> FrameResult:
        """Processes one frame in the calling thread, see `Session.process`; the timing has `infer` too."""
        infer_s = 0.0

        def infer(role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
            nonlocal infer_s
            started = time.perf_counter()
            outputs = self.models[role].run(inputs)
            infer_s += time.perf_counter() - started
            return outputs

        result = session.process(image, timestamp, infer, motion, size)
        return replace(result, timing_ms={**result.timing_ms, "infer": 1e3 * infer_s})


def load_engine(
    model: Path | None = None,
    provider: str = AUTO,
    regressor: Path | None = SHIPPED_REGRESSOR,
    options: RuntimeOptions = DEFAULT_OPTIONS,
) -> Engine:
    """Loads the model file at `model`, by default or for `shipped` the shipped classifier, and warms it up.

    With a classifier the `regressor` provides the ego-lane prior, and is a detector itself; None omits it. A regressor
    as the `model` is the only detector. Raises ModelError for a file that cannot be served, ProviderError if `provider`
    cannot be used.
    """
    keep_freed_memory()
    main = load_model(resolve_model(model), provider, options)
    models: dict[ModelRole, LoadedModel] = {main.info.kind: main}
    if main.info.kind == "classifier" and regressor is not None:
        models["regressor"] = load_model(regressor, provider, options)
        if not isinstance(models["regressor"].info, RegressorInfo):
            raise ModelError(
                f"{regressor} is a {models['regressor'].info.kind}, not a regressor", "give one, or `none`"
            )
    for loaded in models.values():
        loaded.warm_up()
    return Engine.of(models)


def resolve_model(path: Path | None) -> Path:
    """Returns the model file for a user's setting: the shipped classifier for None and for the path `shipped`."""
    return SHIPPED_MODEL if path in (None, _SHIPPED) else path


def resolve_regressor(path: Path | None) -> Path | None:
    """Returns the regressor file for a user's setting: the shipped one for None and for the path `shipped`.

    Returns None for the path `none`.
    """
    if path in (None, _SHIPPED):
        return SHIPPED_REGRESSOR
    return None if path == _NONE else path
