"""A network from an ONNX file, run by onnxruntime."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from lanestream.errors import ModelError, ProviderError
from lanestream.inference.model_info import ModelInfo, parse_info
from lanestream.inference.providers import Provider, choose, cpu_threads, verify

# Batches are padded to one of these, so that a provider meets few shapes and all of them before the first frame.
BUCKETS = (1, 2, 4, 8, 16)


class OnnxModel:
    """A loaded network. Threads may run it at once, though a device gains little from that.

    `info` is the file's own description, `provider` the execution provider that really runs it (`cpu`, `cuda`) and
    `reason` why that one.
    """

    def __init__(self, session: Any, info: ModelInfo, provider: str, reason: str) -> None:
        self._session = session
        self._input = session.get_inputs()[0].name
        self.info = info
        self.provider = provider
        self.reason = reason

    @classmethod
    def load(cls, path: Path, provider: Provider = "auto") -> OnnxModel:
        """The network in the file at `path`.

        Raises ModelError for a file that is none or does not describe itself, ProviderError where `provider` can't be
        had.
        """
        if not path.is_file():
            raise ModelError(f"no model file at {path}", "give the path of an exported .onnx file")
        choice = choose(provider)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = cpu_threads()
        options.log_severity_level = 3
        # Threads that spin while they wait take the processors from those that decode and propose the next frame.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            session = onnxruntime.InferenceSession(
                str(path), options, providers=list(choice.names), enable_fallback=False
            )
        except Exception as error:  # onnxruntime raises a type per status, all of them private
            if provider == "cuda":
                raise ProviderError(f"CUDA can't be used: {_line(error)}", "use the provider auto or cpu") from error
            raise ModelError(
                f"{path} is not a model that can be run: {_line(error)}", "give an exported .onnx file"
            ) from error
        info = parse_info(session.get_modelmeta().custom_metadata_map, str(path))
        return cls(session, info, verify(provider, session.get_providers()), choice.reason)

    @property
    def name(self) -> str:
        """The model's name and version."""
        return f"{self.info.name} {self.info.version}"

    @property
    def buckets(self) -> tuple[int, ...]:
        """The batch sizes that it runs."""
        return BUCKETS

    @property
    def metadata(self) -> dict[str, Any]:
        """What the model file says of itself."""
        return self.info.model_dump()

    def warm_up(self) -> None:
        """Runs every batch size once, so that the first frame waits for nothing."""
        size = self.info.input_size
        for batch in BUCKETS:
            self.run(np.zeros((batch, size, size, 3), np.uint8))

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Outputs (N, outputs) for RGB inputs (N, size, size, 3); any N, also 0 and beyond the largest bucket."""
        parts = [self._padded(inputs[i : i + BUCKETS[-1]]) for i in range(0, len(inputs), BUCKETS[-1])]
        return np.concatenate(parts) if parts else np.zeros((0, self.info.outputs), np.float32)

    def _padded(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        bucket = next(size for size in BUCKETS if size >= len(inputs))
        padding = np.zeros((bucket - len(inputs), *inputs.shape[1:]), np.uint8)
        outputs = self._session.run(None, {self._input: np.concatenate([inputs, padding])})[0]
        return np.asarray(outputs[: len(inputs)], dtype=np.float32)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
