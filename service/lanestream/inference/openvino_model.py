"""A network that OpenVINO runs on the CPU."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lanestream.errors import ModelError, ProviderError, one_line
from lanestream.host import processors
from lanestream.inference.loaded_model import LoadedModel, Placement, runtime_message
from lanestream.inference.model_info import METADATA_KEY, ModelInfo, parse_info, require_file
from lanestream.inference.providers import DEFAULT_OPTIONS, OPENVINO, ProviderSpec, RuntimeOptions

# A new batch size costs OpenVINO a few milliseconds once, and every size costs the same per input.
_BATCH_SIZES: Final = tuple(range(1, 9))

_TELEMETRY: Final = "openvino_telemetry"


def load(
    path: Path,
    spec: ProviderSpec = OPENVINO,
    options: RuntimeOptions = DEFAULT_OPTIONS,
    reason: str = "it was requested",
) -> OpenVinoModel:
    """Loads the network in the file at `path` on the CPU.

    Raises ModelError if the file is not a model or does not describe itself, ProviderError if OpenVINO does not work.
    """
    require_file(path)
    openvino = import_openvino()
    # Only the ONNX reader: the one that detects the format writes complaints about the others to stderr.
    reader = openvino.frontend.FrontEndManager().load_by_framework("onnx")
    try:
        read = reader.load(str(path))
    except Exception as error:  # OpenVINO raises a type per failure, all of them private
        raise ModelError(
            f"{path} is not a model that can run: {runtime_message(error)}", "give an exported .onnx file"
        ) from error
    try:
        model = reader.convert(read)
        # Its CPU plugin gives the thread that starts it a signal stack, and frees it with the last network, in whatever
        # thread that happens. A signal would then crash the thread, so it is one that ends before.
        with ThreadPoolExecutor(1) as starter:
            compiled = starter.submit(_compile, openvino, model, options).result()
    except Exception as error:
        raise ProviderError(
            f"OpenVINO can't run {path}: {runtime_message(error)}", "use the provider auto or cpu"
        ) from error
    threads = compiled.get_property("INFERENCE_NUM_THREADS")
    placement = Placement(spec.name, reason, threads, _nodes(compiled), _BATCH_SIZES)
    return OpenVinoModel(compiled, _info(model, path), placement)


class OpenVinoModel(LoadedModel):
    """A network that OpenVINO runs, in the precision of its file."""

    def __init__(self, compiled: Any, info: ModelInfo, placement: Placement) -> None:
        super().__init__(info, placement)
        self._request = compiled.create_infer_request()

    def _outputs(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self._request.infer([inputs], share_inputs=True)
        return np.array(self._request.get_output_tensor(0).data, dtype=np.float32)


def import_openvino() -> Any:
    """Imports the package `openvino`. Raises ProviderError if it is not installed."""
    try:
        with _without_telemetry():
            return import_module("openvino")
    except ImportError as error:
        raise ProviderError(
            f"OpenVINO does not work: {one_line(error)}", "pip install 'lanestream[openvino]', or use the provider cpu"
        ) from error


@contextmanager
def _without_telemetry() -> Iterator[None]:
    """Hides the package with which OpenVINO reports every import to Google Analytics; OpenVINO works without it.

    If OpenVINO was imported before, this changes nothing.
    """
    if _TELEMETRY in sys.modules:
        yield
        return
    sys.modules[_TELEMETRY] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        del sys.modules[_TELEMETRY]


def _compile(openvino: Any, model: Any, options: RuntimeOptions) -> Any:
    return openvino.Core().compile_model(model, "CPU", _properties(options.threads))


def _properties(threads: int | None) -> Mapping[str, Any]:
    return {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": threads or processors(),
        # By default it computes in bfloat16 if the CPU can, which costs more accuracy than an export may lose;
        # quantized layers stay int8.
        "INFERENCE_PRECISION_HINT": "f32",
        # Threads pinned to processors block other processes that are pinned to the same ones.
        "ENABLE_CPU_PINNING": False,
    }


def _info(model: Any, path: Path) -> ModelInfo:
    where = ["framework", METADATA_KEY]
    metadata = {METADATA_KEY: model.get_rt_info(where).astype(str)} if model.has_rt_info(where) else {}
    return parse_info(metadata, str(path))


def _nodes(compiled: Any) -> Mapping[str, int]:
    """Returns how many compiled nodes run in each precision, the most first."""
    nodes = [node.get_rt_info() for node in compiled.get_runtime_model().get_ops()]
    counts = Counter(each["runtimePrecision"].astype(str) for each in nodes if each["layerType"].astype(str) != "Const")
    return {f"CPU {precision}": count for precision, count in counts.most_common()}
