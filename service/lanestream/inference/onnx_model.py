"""A network that onnxruntime runs: on the CPU, on CUDA, or by TensorRT."""

from __future__ import annotations

import contextlib
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from lanestream.errors import ModelError, ProviderError
from lanestream.host import processors
from lanestream.inference.loaded_model import LoadedModel, Placement, runtime_message
from lanestream.inference.model_info import ModelInfo, parse_info, require_file
from lanestream.inference.providers import CPU, CUDA, DEFAULT_OPTIONS, ProviderSpec, RuntimeOptions

# On the CPU a batch of any size costs the same per input, so nothing is padded. Beyond 8 inputs nothing is gained, and
# memory is lost: onnxruntime keeps what its largest batch needed.
CPU_BATCH_SIZES: Final = tuple(range(1, 9))
# A GPU searches for its algorithms at each new size, so it gets few sizes, all of them before the first frame.
GPU_BATCH_SIZES: Final = (1, 2, 4, 8, 16, 32, 64)


def load(
    path: Path, spec: ProviderSpec = CPU, options: RuntimeOptions = DEFAULT_OPTIONS, reason: str = "it was requested"
) -> OnnxModel:
    """Loads the network in the file at `path` on the provider `spec`, whose build of onnxruntime is installed.

    Raises ModelError if the file is not a model or does not describe itself, ProviderError if the provider does not
    work.
    """
    require_file(path)
    session = _gpu_session(path, spec, options) if spec.on_gpu else _cpu_session(path, options.threads)
    verify_provider(spec, session.get_providers())
    kind, sizes = (BoundOnnxModel, GPU_BATCH_SIZES) if spec.on_gpu else (OnnxModel, CPU_BATCH_SIZES)
    threads = session.get_session_options().intra_op_num_threads
    return kind(session, _info(session, path), Placement(spec.name, reason, threads, _nodes(session), sizes))


class OnnxModel(LoadedModel):
    """A network that onnxruntime runs."""

    def __init__(self, session: Any, info: ModelInfo, placement: Placement) -> None:
        super().__init__(info, placement)
        self._session = session
        self._input = session.get_inputs()[0].name

    def _outputs(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        return np.asarray(self._session.run(None, {self._input: inputs})[0], dtype=np.float32)


class BoundOnnxModel(OnnxModel):
    """A network on a device with buffers there for each batch size: a run copies inputs in and outputs out."""

    device = "cuda"

    def __init__(self, session: Any, info: ModelInfo, placement: Placement) -> None:
        super().__init__(session, info, placement)
        self._output = session.get_outputs()[0].name
        self._bound: dict[int, tuple[Any, Any, Any]] = {}

    def _outputs(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        binding, source, target = self._bound.get(len(inputs)) or self._bind(inputs.shape)
        source.update_inplace(inputs)
        self._session.run_with_iobinding(binding)
        # On the CPU itself this would be a view of the buffer.
        return np.array(target.numpy(), dtype=np.float32)

    def _bind(self, shape: tuple[int, ...]) -> tuple[Any, Any, Any]:
        make = onnxruntime.OrtValue.ortvalue_from_shape_and_type
        source = make(list(shape), np.uint8, self.device, 0)
        target = make([shape[0], self.info.outputs], np.float32, self.device, 0)
        binding = self._session.io_binding()
        binding.bind_ortvalue_input(self._input, source)
        binding.bind_ortvalue_output(self._output, target)
        return self._bound.setdefault(shape[0], (binding, source, target))


def preload_gpu_libraries() -> None:
    """Loads CUDA and cuDNN from Python packages, where the system's loader does not look; problems go to stderr."""
    with contextlib.redirect_stdout(sys.stderr):
        onnxruntime.preload_dlls()


def verify_provider(spec: ProviderSpec, running: list[str]) -> None:
    """Raises ProviderError if a session for `spec` runs on another of onnxruntime's providers.

    onnxruntime falls back silently, even with its fallback off: only the session itself shows it.
    """
    if running[0] != spec.onnxruntime_name:
        raise ProviderError(
            f"{spec.title} does not work: onnxruntime fell back to {running[0]}",
            "check the driver and the libraries with `lanestream doctor`, or use the provider auto or cpu",
        )


def session_options(threads: int | None) -> Any:
    """Returns onnxruntime's options for every session; `threads` as in RuntimeOptions."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or processors()
    # Only fatal errors: it raises all others, too, and they are reported once.
    options.log_severity_level = 4
    # Threads that spin while they wait take processor time from those that decode and search the next frame.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.record_ep_graph_assignment_info", "1")
    return options


def _cpu_session(path: Path, threads: int | None) -> Any:
    try:
        return onnxruntime.InferenceSession(
            str(path), session_options(threads), providers=[CPU.onnxruntime_name], enable_fallback=False
        )
    except Exception as error:  # onnxruntime raises a type per status, all of them private
        raise ModelError(
            f"{path} is not a model that can run: {runtime_message(error)}", "give an exported .onnx file"
        ) from error


def _gpu_session(path: Path, spec: ProviderSpec, options: RuntimeOptions) -> Any:
    # Loading on the CPU first reports an invalid file as such, not as a problem of the device.
    info = _info(_cpu_session(path, 1), path)
    preload_gpu_libraries()
    # What a provider cannot run goes to CUDA.
    providers = [(each.onnxruntime_name, dict(each.options(info, options))) for each in dict.fromkeys((spec, CUDA))]
    try:
        return onnxruntime.InferenceSession(
            str(path), session_options(options.threads), providers=providers, enable_fallback=False
        )
    except Exception as error:
        raise ProviderError(
            f"{spec.name} does not work: {runtime_message(error)}",
            "check the driver and the libraries with `lanestream doctor`, or use the provider auto or cpu",
        ) from error


def _info(session: Any, path: Path) -> ModelInfo:
    return parse_info(session.get_modelmeta().custom_metadata_map, str(path))


def _nodes(session: Any) -> Mapping[str, int]:
    """Returns how many nodes each execution provider runs, the most first."""
    counts = Counter(dict.fromkeys(session.get_providers(), 0))
    for part in session.get_provider_graph_assignment_info():
        counts[part.ep_name] += len(part.get_nodes())
    return {name.removesuffix("ExecutionProvider"): count for name, count in counts.most_common()}
