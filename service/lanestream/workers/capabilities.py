"""What a service can do: its detectors by name, with a summary of the model of each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lanestream.errors import NoDetectorError

if TYPE_CHECKING:
    from lanestream.engine import Engine
    from lanestream.inference.loaded_model import LoadedModel


@dataclass(frozen=True)
class ModelSummary:
    """A loaded model as clients see it; `provider`, `reason` and `fell_back` are those of its `Placement`."""

    name: str
    provider: str
    reason: str
    fell_back: bool
    sha256: str
    metadata: Mapping[str, Any]

    @classmethod
    def of(cls, model: LoadedModel) -> ModelSummary:
        """Returns the summary of `model`."""
        placement = model.placement
        return cls(model.name, placement.provider, placement.reason, placement.fell_back, model.sha256, model.metadata)


@dataclass(frozen=True)
class DetectorInfo:
    """A detector: the name by which users request it, and the model that it requires."""

    detector: str
    model: ModelSummary


@dataclass(frozen=True)
class Capabilities:
    """All detectors of a service; the first one is the default."""

    detectors: tuple[DetectorInfo, ...]

    @classmethod
    def of(cls, engine: Engine) -> Capabilities:
        """Returns the capabilities of an engine."""
        return cls(tuple(DetectorInfo(name, ModelSummary.of(engine.main_model(name))) for name in engine.detectors))

    def select(self, name: str | None = None) -> DetectorInfo:
        """Returns the detector `name`, by default the first one. Raises NoDetectorError if it is not loaded."""
        for info in self.detectors:
            if name in (None, info.detector):
                return info
        raise NoDetectorError(f"there is no detector {name} here", f"ask for {', '.join(_names(self.detectors))}")


def _names(detectors: Iterable[DetectorInfo]) -> list[str]:
    return [info.detector for info in detectors]
