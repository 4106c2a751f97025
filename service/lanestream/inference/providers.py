"""The table of execution providers: what can run a network, what must be installed, and what `auto` selects.

Importing it is cheap: a runtime is imported only when it is used. To add a provider of onnxruntime, add a row here and
its package to an extra in pyproject.toml. Another runtime also needs a module with a `load` function.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lanestream.errors import ProviderError, needs_extra
from lanestream.host import instruction_sets

if TYPE_CHECKING:
    from lanestream.inference.loaded_model import LoadedModel
    from lanestream.inference.model_info import ModelInfo

AUTO: Final = "auto"


@dataclass(frozen=True)
class RuntimeOptions:
    """How networks run. `threads` is the number of CPU threads of one run; None: one for each available processor.

    `engine_cache` is the folder in which TensorRT keeps the engines it builds; None builds them at each start.
    """

    threads: int | None = None
    engine_cache: Path | None = None


DEFAULT_OPTIONS: Final = RuntimeOptions()


@dataclass(frozen=True)
class Installed:
    """What is installed here: onnxruntime's providers by its names for them, OpenVINO, and whether the CPU has AMX.

    A provider that is installed may still not work: only loading a network shows that.
    """

    onnxruntime: frozenset[str]
    openvino: bool
    amx: bool

    @classmethod
    def here(cls) -> Installed:
        """Returns what is installed on this machine. Raises MissingExtraError if onnxruntime is missing or broken."""
        with needs_extra("cpu"):
            onnxruntime = frozenset(import_module("onnxruntime").get_available_providers())
        return cls(
            onnxruntime=onnxruntime,
            openvino=find_spec("openvino") is not None,
            amx="amx_int8" in instruction_sets(),
        )

    def without_gpus(self) -> Installed:
        """Returns the same on a machine without a GPU."""
        return replace(self, onnxruntime=self.onnxruntime & {CPU.onnxruntime_name})


@dataclass(frozen=True)
class ProviderSpec:
    """One execution provider.

    `onnxruntime_name` is onnxruntime's name for it, empty for another runtime. `auto_reason` returns why `auto` takes
    the provider, given what is installed, or None if it does not. `missing` is the message and the hint if it is not
    installed. `module` has a function `load(path, spec, options, reason)`. `options` returns onnxruntime's options for
    the provider.
    """

    name: str
    title: str
    is_installed: Callable[[Installed], bool]
    missing: tuple[str, str]
    auto_reason: Callable[[Installed], str | None]
    module: str = "lanestream.inference.onnx_model"
    onnxruntime_name: str = ""
    on_gpu: bool = False
    options: Callable[[ModelInfo, RuntimeOptions], Mapping[str, str]] = lambda info, options: {}  # noqa: ARG005

    def require(self, installed: Installed) -> None:
        """Raises ProviderError if it is not installed."""
        if not self.is_installed(installed):
            raise ProviderError(*self.missing)

    def load(self, path: Path, options: RuntimeOptions, reason: str) -> LoadedModel:
        """Loads the model file at `path`. Raises ModelError for an invalid file, ProviderError if it cannot run."""
        model: LoadedModel = import_module(self.module).load(path, self, options, reason)
        return model


def _of_onnxruntime(name: str) -> Callable[[Installed], bool]:
    return lambda installed: name in installed.onnxruntime


def _no_gpu_build(title: str) -> tuple[str, str]:
    return (
        f"the installed onnxruntime has no {title}",
        "install lanestream[gpu] instead of [cpu], or use the provider auto or cpu",
    )


def tensorrt_options(info: ModelInfo, options: RuntimeOptions) -> Mapping[str, str]:
    """Returns TensorRT's options: half precision only for files in half precision, engines kept in the cache."""
    found = {"trt_fp16_enable": str(int(info.precision == "fp16"))}
    if options.engine_cache is not None:
        cache = str(options.engine_cache)
        found |= {"trt_engine_cache_enable": "1", "trt_engine_cache_path": cache}
        found |= {"trt_timing_cache_enable": "1", "trt_timing_cache_path": cache}
    return found


def cuda_options(info: ModelInfo, options: RuntimeOptions) -> Mapping[str, str]:
    """Returns CUDA's options."""
    del info, options
    return {"cudnn_conv_algo_search": "HEURISTIC", "arena_extend_strategy": "kSameAsRequested"}


CUDA: Final = ProviderSpec(
    name="cuda",
    title="CUDA",
    is_installed=_of_onnxruntime("CUDAExecutionProvider"),
    missing=_no_gpu_build("CUDA"),
    auto_reason=lambda installed: "CUDA is available",  # noqa: ARG005
    onnxruntime_name="CUDAExecutionProvider",
    on_gpu=True,
    options=cuda_options,
)
TENSORRT: Final = ProviderSpec(
    name="tensorrt",
    title="TensorRT",
    is_installed=_of_onnxruntime("TensorrtExecutionProvider"),
    missing=_no_gpu_build("TensorRT"),
    # It builds engines for minutes, so users have to ask for it.
    auto_reason=lambda installed: None,  # noqa: ARG005
    onnxruntime_name="TensorrtExecutionProvider",
    on_gpu=True,
    options=tensorrt_options,
)
OPENVINO: Final = ProviderSpec(
    name="openvino",
    title="OpenVINO",
    is_installed=lambda installed: installed.openvino,
    missing=("OpenVINO is not installed", "pip install 'lanestream[openvino]', or use the provider auto or cpu"),
    # It multiplies int8 matrices in AMX tiles and is up to 1.5 times as fast there; without AMX onnxruntime is a little
    # faster (`python tools/providers.py`).
    auto_reason=lambda installed: "OpenVINO is installed and faster on a CPU with AMX" if installed.amx else None,
    module="lanestream.inference.openvino_model",
)
CPU: Final = ProviderSpec(
    name="cpu",
    title="CPU",
    is_installed=_of_onnxruntime("CPUExecutionProvider"),
    missing=("the installed onnxruntime has no CPU provider", "install lanestream[cpu]"),
    auto_reason=lambda installed: (
        "onnxruntime on the CPU is always available" if installed.amx else "onnxruntime is faster on a CPU without AMX"
    ),
    onnxruntime_name="CPUExecutionProvider",
)

# `auto` tries them in this order; the last one always works.
PROVIDERS: Final = (CUDA, TENSORRT, OPENVINO, CPU)
PROVIDER_NAMES: Final = (AUTO, *(spec.name for spec in PROVIDERS))


def find_provider(name: str) -> ProviderSpec:
    """Returns the provider of that name. Raises ProviderError for an unknown name."""
    for spec in PROVIDERS:
        if spec.name == name:
            return spec
    raise ProviderError(f"{name!r} is not a provider", f"use {', '.join(PROVIDER_NAMES)}")


def attempts(provider: str, installed: Installed) -> list[tuple[ProviderSpec, str]]:
    """Returns the providers to try for a requested one or `auto`, in order, each with the reason to take it."""
    if provider != AUTO:
        return [(find_provider(provider), f"{provider} was requested")]
    reasons = [(spec, spec.auto_reason(installed)) for spec in PROVIDERS]
    return [(spec, reason) for spec, reason in reasons if reason is not None]


def cuda_version() -> str | None:
    """Returns the CUDA version that the installed onnxruntime was built for, or None for a CPU build."""
    version: str | None = import_module("onnxruntime").cuda_version or None
    return version
