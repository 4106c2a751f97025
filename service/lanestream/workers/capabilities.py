"""What a service offers: its detectors by name, with what is to be told of the network of each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lanestream.detection import chosen

if TYPE_CHECKING:
    from lanestream.detection import Network, Pipeline
    from lanestream.protocol import DetectorName


@dataclass(frozen=True)
class ModelSummary:
    """A loaded network as others see it: the fields are those of `lanestream.detection.Network`."""

    name: str
    provider: str
    reason: str
    fell_back: bool
    sha256: str
    metadata: Mapping[str, Any]

    @classmethod
    def of(cls, network: Network) -> ModelSummary:
        """What is to be told of `network`."""
        told = network.name, network.provider, network.reason, network.fell_back, network.sha256
        return cls(*told, dict(network.metadata))


@dataclass(frozen=True)
class Offer:
    """A detector by the name that users ask for it, and the network that answers it."""

    detector: DetectorName
    network: ModelSummary


class Capabilities:
    """All detectors of a service; the first one is the default."""

    def __init__(self, offers: Iterable[Offer]) -> None:
        self.all = tuple(offers)

    @classmethod
    def of(cls, pipelines: Iterable[Pipeline]) -> Capabilities:
        """What these offer."""
        return cls(Offer(pipeline.name, ModelSummary.of(pipeline.network)) for pipeline in pipelines)

    def chosen(self, name: DetectorName | None = None) -> Offer:
        """The offer of that name, the default one where None. Raises NoDetectorError where there is none."""
        return chosen({offer.detector: offer for offer in self.all}, name)
