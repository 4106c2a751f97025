"""A network from an ONNX file, run by onnxruntime: on the CPU, on CUDA, or by TensorRT."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from lanestream.errors import ModelError, ProviderError, one_line
from lanestream.host import processors
from lanestream.inference.loaded_model import LoadedModel, Placement
from lanestream.inference.model_info import ModelInfo, parse_info, require_file
from lanestream.inference.providers import NAMES, OnnxProvider, preload_gpu_libraries, verify
from lanestream.runtime import DEFAULT_OPTIONS, RuntimeOptions

# The CPU takes any size at the same price, so that nothing is padded there, and gains nothing beyond some 8 at once.
CPU_BUCKETS: Final = tuple(range(1, 17))
# A GPU meets few shapes, and all of them before the first frame: it searches for its algorithms at each new one.
GPU_BUCKETS: Final = (1, 2, 4, 8, 16, 32, 64)

_CUDA_OPTIONS: Final = {"cudnn_conv_algo_search": "HEURISTIC", "arena_extend_strategy": "kSameAsRequested"}


class OnnxModel(LoadedModel):
    """A network that onnxruntime runs."""

    def __init__(self, session: Any, info: ModelInfo, placement: Placement) -> None:
        super().__init__(info, placement)
        self._session = session
        self._input = session.get_inputs()[0].name

    @classmethod
    def load(
        cls,
        path: Path,
        provider: OnnxProvider = "cpu",
        options: RuntimeOptions = DEFAULT_OPTIONS,
        reason: str = "it was asked for",
    ) -> OnnxModel:
        """The network in the file at `path`, on `provider`, whose build of onnxruntime is installed.

        Raises ModelError for a file that is none or does not describe itself, ProviderError where `provider` can't be
        had.
        """
        require_file(path)
        if provider == "cpu":
            session = _cpu_session(path, options.threads)
            kind, buckets = OnnxModel, CPU_BUCKETS
        else:
            session = _gpu_session(path, provider, options)
            kind, buckets = BoundOnnxModel, GPU_BUCKETS
        verify(provider, session.get_providers())
        threads = session.get_session_options().intra_op_num_threads
        return kind(session, _info(session, path), Placement(provider, reason, threads, _nodes(session), buckets))

    def _outputs(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        return np.asarray(self._session.run(None, {self._input: inputs})[0], dtype=np.float32)


class BoundOnnxModel(OnnxModel):
    """A network on a device, with buffers there for each batch size: a run copies inputs in and outputs out."""

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


def _cpu_session(path: Path, threads: int | None) -> Any:
    try:
        return onnxruntime.InferenceSession(
            str(path), _session_options(threads), providers=[NAMES["cpu"]], enable_fallback=False
        )
    except Exception as error:  # onnxruntime raises a type per status, all of them private
        raise ModelError(
            f"{path} is not a model that can be run: {one_line(error)}", "give an exported .onnx file"
        ) from error


def _gpu_session(path: Path, provider: Literal["cuda", "tensorrt"], options: RuntimeOptions) -> Any:
    # What is wrong with the file is told before the device is asked, and is not taken for its fault.
    info = _info(_cpu_session(path, 1), path)
    preload_gpu_libraries()
    chosen = [(NAMES["cuda"], dict(_CUDA_OPTIONS))]
    if provider == "tensorrt":
        chosen.insert(0, (NAMES["tensorrt"], tensorrt_options(info, options.engine_cache)))
    try:
        return onnxruntime.InferenceSession(
            str(path), _session_options(options.threads), providers=chosen, enable_fallback=False
        )
    except Exception as error:
        raise ProviderError(
            f"{provider} can't be used: {one_line(error)}",
            "check the driver and the libraries with `lanestream doctor`, or use the provider auto or cpu",
        ) from error


def tensorrt_options(info: ModelInfo, cache: Path | None) -> dict[str, str]:
    """TensorRT's options for a network: half precision for files in half precision alone, engines kept in `cache`."""
    options = {"trt_fp16_enable": str(int(info.precision == "fp16"))}
    if cache is not None:
        options |= {"trt_engine_cache_enable": "1", "trt_engine_cache_path": str(cache)}
        options |= {"trt_timing_cache_enable": "1", "trt_timing_cache_path": str(cache)}
    return options


def _session_options(threads: int | None) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or processors()
    options.log_severity_level = 3
    # Threads that spin while they wait take the processors from those that decode and propose the next frame.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.record_ep_graph_assignment_info", "1")
    return options


def _info(session: Any, path: Path) -> ModelInfo:
    return parse_info(session.get_modelmeta().custom_metadata_map, str(path))


def _nodes(session: Any) -> Mapping[str, int]:
    """How many nodes each execution provider runs, the most first."""
    parts = session.get_provider_graph_assignment_info()
    counts = Counter(dict.fromkeys(session.get_providers(), 0))
    for part in parts:
        counts[part.ep_name] += len(part.get_nodes())
    return {name.removesuffix("ExecutionProvider"): count for name, count in counts.most_common()}
