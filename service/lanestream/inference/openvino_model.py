"""A network from an ONNX file, run by OpenVINO on the CPU."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lanestream.errors import ModelError, ProviderError, one_line
from lanestream.host import processors
from lanestream.inference.loaded_model import LoadedModel, Placement
from lanestream.inference.model_info import METADATA_KEY, ModelInfo, parse_info, require_file
from lanestream.runtime import DEFAULT_OPTIONS, RuntimeOptions

# A new batch size costs OpenVINO a few milliseconds once, and no size is dearer than another.
BUCKETS: Final = tuple(range(1, 17))

_TELEMETRY: Final = "openvino_telemetry"


class OpenVinoModel(LoadedModel):
    """A network that OpenVINO runs, in the precision of its file."""

    def __init__(self, compiled: Any, info: ModelInfo, placement: Placement) -> None:
        super().__init__(info, placement)
        self._request = compiled.create_infer_request()

    @classmethod
    def load(
        cls, path: Path, options: RuntimeOptions = DEFAULT_OPTIONS, reason: str = "it was asked for"
    ) -> OpenVinoModel:
        """The network in the file at `path`, on the CPU.

        Raises ModelError for a file that is none or does not describe itself, ProviderError where OpenVINO can't be
        had.
        """
        require_file(path)
        openvino = imported()
        # Its reader of ONNX alone: the one that guesses the format complains on stderr of all others.
        reader = openvino.frontend.FrontEndManager().load_by_framework("onnx")
        try:
            read = reader.load(str(path))
        except Exception as error:  # OpenVINO raises a type per failure, all of them private
            raise ModelError(
                f"{path} is not a model that can be run: {one_line(error)}", "give an exported .onnx file"
            ) from error
        try:
            model = reader.convert(read)
            compiled = openvino.Core().compile_model(model, "CPU", _properties(options.threads))
        except Exception as error:
            raise ProviderError(
                f"OpenVINO can't run {path}: {one_line(error)}", "use the provider auto or cpu"
            ) from error
        info = _info(model, path)
        threads = compiled.get_property("INFERENCE_NUM_THREADS")
        return cls(compiled, info, Placement("openvino", reason, threads, _nodes(compiled), BUCKETS))

    def _outputs(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self._request.infer([inputs], share_inputs=True)
        return np.array(self._request.get_output_tensor(0).data, dtype=np.float32)


def imported() -> Any:
    """The package `openvino`. Raises ProviderError where it is not installed."""
    try:
        with _without_telemetry():
            return import_module("openvino")
    except ImportError as error:
        raise ProviderError(
            f"OpenVINO can't be used: {one_line(error)}", "pip install 'lanestream[openvino]', or use the provider cpu"
        ) from error


@contextmanager
def _without_telemetry() -> Iterator[None]:
    """Hides the package by which OpenVINO tells Google Analytics of every import; it can do without.

    Whoever imported OpenVINO before has decided otherwise.
    """
    if _TELEMETRY in sys.modules:
        yield
        return
    sys.modules[_TELEMETRY] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        del sys.modules[_TELEMETRY]


def _properties(threads: int | None) -> Mapping[str, Any]:
    return {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": threads or processors(),
        # By itself it computes in bfloat16 where the CPU can, whatever the file's precision, which costs more accuracy
        # than an export is allowed; quantised layers stay int8.
        "INFERENCE_PRECISION_HINT": "f32",
        # Threads bound to processors stand in the way of other processes bound to the same ones.
        "ENABLE_CPU_PINNING": False,
    }


def _info(model: Any, path: Path) -> ModelInfo:
    where = ["framework", METADATA_KEY]
    told = {METADATA_KEY: model.get_rt_info(where).astype(str)} if model.has_rt_info(where) else {}
    return parse_info(told, str(path))


def _nodes(compiled: Any) -> Mapping[str, int]:
    """How many of the nodes that were compiled run in each precision, the most first."""
    told = [node.get_rt_info() for node in compiled.get_runtime_model().get_ops()]
    counts = Counter(each["runtimePrecision"].astype(str) for each in told if each["layerType"].astype(str) != "Const")
    return {f"CPU {precision}": count for precision, count in counts.most_common()}
