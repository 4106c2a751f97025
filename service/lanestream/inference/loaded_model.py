"""A loaded network, whichever runtime runs it."""

from __future__ import annotations

import re
import threading
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lanestream.errors import ModelError, one_line
from lanestream.inference.model_info import ModelInfo

# Where in their own source code the runtimes found a problem: onnxruntime, then OpenVINO.
_CODE_PLACES: Final = re.compile(
    r"\[ONNXRuntimeError\] : \d+ : \w+ : |/\S+:\d+ [^()]*\([^()]*\) "
    r"|Exception from \S+:\d+:\s+|Check '[^']*' failed at \S+:\d+:\s+"
)


@dataclass(frozen=True)
class Placement:
    """Where a network really runs, and how.

    `provider` is the execution provider and `reason` why it was selected; `nodes` counts the nodes of the graph by what
    runs them. `batch_sizes` are the supported ones, ascending; other batches are padded to the next size. `threads` is
    the number of CPU threads of one run. `fell_back` is True if a better provider is installed but does not work.
    """

    provider: str
    reason: str
    threads: int
    nodes: Mapping[str, int]
    batch_sizes: tuple[int, ...]
    fell_back: bool = False


class LoadedModel(ABC):
    """A network that is ready to run. Threads may share it; it runs one batch at a time.

    `sha256` is the hash of its file in hexadecimal; empty if unknown.
    """

    def __init__(self, info: ModelInfo, placement: Placement) -> None:
        self.info = info
        self.placement = placement
        self.sha256 = ""
        # A run uses all processors or the whole device. Two at a time would not be faster but need twice the memory.
        self._running = threading.Lock()

    @property
    def name(self) -> str:
        """The model's name and version."""
        return f"{self.info.name} {self.info.version}"

    @property
    def largest_batch(self) -> int:
        """The most inputs of one run; more are split."""
        return self.placement.batch_sizes[-1]

    @property
    def metadata(self) -> dict[str, Any]:
        """What the model file says about itself."""
        return self.info.model_dump()

    def warm_up(self) -> None:
        """Runs every batch size once, so that the first frame does not wait. Raises ModelError if a run fails."""
        # The largest first, then the smallest: memory is allocated once, and an engine that is built for a range of
        # sizes is built for all of them.
        *smaller, largest = self.placement.batch_sizes
        try:
            for batch in (largest, *smaller):
                self.run(self.blank(batch))
        except Exception as error:  # also of onnxruntime and OpenVINO, which have types of their own
            raise ModelError(
                f"the model {self.name} fails when it runs on {self.placement.provider}: {runtime_message(error)}",
                "give a file exported by `lanestream export`, and enough memory",
            ) from error

    def blank(self, batch: int) -> NDArray[np.uint8]:
        """Returns black inputs (batch, size, size, 3)."""
        size = self.info.input_size
        return np.zeros((batch, size, size, 3), np.uint8)

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns outputs (N, outputs) for RGB inputs (N, size, size, 3); N may be 0 or beyond the largest batch."""
        largest = self.largest_batch
        with self._running:
            parts = [self._run_padded(inputs[i : i + largest]) for i in range(0, len(inputs), largest)]
        if not parts:
            return np.zeros((0, self.info.outputs), np.float32)
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _run_padded(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        count = len(inputs)
        batch = next(size for size in self.placement.batch_sizes if size >= count)
        if batch > count:
            padded = self.blank(batch)
            padded[:count] = inputs
            inputs = padded
        return self._outputs(np.ascontiguousarray(inputs))[:count]

    @abstractmethod
    def _outputs(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns outputs (N, outputs) that the caller may keep, for contiguous inputs; N is one of the batch sizes."""


def runtime_message(error: Exception) -> str:
    """Returns the message of an error of a runtime on one line, without places in the runtime's source code."""
    return one_line(_CODE_PLACES.sub("", str(error))) or type(error).__name__
