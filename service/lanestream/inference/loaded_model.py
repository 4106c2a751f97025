"""A loaded network, whichever runtime runs it."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lanestream.inference.model_info import ModelInfo


@dataclass(frozen=True)
class Placement:
    """Where a network really runs, and how.

    `provider` is the execution provider and `reason` why that one; `nodes` counts the graph's nodes by what runs them.
    `buckets` are the batch sizes that it runs, ascending. `threads` are those of one run, on the CPU. It
    `fell_back` where a provider that is installed, and would have been better, can't be used.
    """

    provider: str
    reason: str
    threads: int
    nodes: Mapping[str, int]
    buckets: tuple[int, ...]
    fell_back: bool = False


class LoadedModel(ABC):
    """A network that is ready to be asked. Threads may share it; it runs one batch at a time.

    `sha256` is that of its file, in hexadecimal digits; empty where nobody looked.
    """

    def __init__(self, info: ModelInfo, placement: Placement) -> None:
        self.info = info
        self.placement = placement
        self.sha256 = ""
        # A run takes all processors or the whole device: two at once gain nothing, and need the memory of two.
        self._running = threading.Lock()

    @property
    def name(self) -> str:
        """The model's name and version."""
        return f"{self.info.name} {self.info.version}"

    @property
    def provider(self) -> str:
        """The execution provider that really runs it: `cpu`, `cuda`, `tensorrt` or `openvino`."""
        return self.placement.provider

    @property
    def reason(self) -> str:
        """Why that one."""
        return self.placement.reason

    @property
    def fell_back(self) -> bool:
        """Whether a better one is installed and can't be used."""
        return self.placement.fell_back

    @property
    def buckets(self) -> tuple[int, ...]:
        """The batch sizes that it runs, ascending; one run takes no more than the last."""
        return self.placement.buckets

    @property
    def metadata(self) -> dict[str, Any]:
        """What the model file says of itself."""
        return self.info.model_dump()

    def warm_up(self) -> None:
        """Runs every batch size once, so that the first frame waits for nothing."""
        # The largest first, then the smallest: memory is asked for once, and an engine that is built for a range of
        # sizes is built for all of them.
        *between, largest = self.buckets
        for batch in (largest, *between):
            self.run(self.blank(batch))

    def blank(self, batch: int) -> NDArray[np.uint8]:
        """Black inputs (batch, size, size, 3)."""
        size = self.info.input_size
        return np.zeros((batch, size, size, 3), np.uint8)

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Outputs (N, outputs) for RGB inputs (N, size, size, 3); any N, also 0 and beyond the largest bucket."""
        largest = self.buckets[-1]
        with self._running:
            parts = [self._bucketed(inputs[i : i + largest]) for i in range(0, len(inputs), largest)]
        if not parts:
            return np.zeros((0, self.info.outputs), np.float32)
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _bucketed(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        count = len(inputs)
        bucket = next(size for size in self.buckets if size >= count)
        if bucket > count:
            padded = self.blank(bucket)
            padded[:count] = inputs
            inputs = padded
        return self._outputs(np.ascontiguousarray(inputs))[:count]

    @abstractmethod
    def _outputs(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Outputs (N, outputs), the caller's to keep, for contiguous inputs (N, size, size, 3); N is a bucket."""
