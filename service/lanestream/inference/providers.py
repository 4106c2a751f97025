"""Choosing an execution provider, and saying honestly which one was got."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Final, Literal

import onnxruntime

from lanestream.errors import ProviderError
from lanestream.host import instruction_sets
from lanestream.runtime import Provider

# The providers of onnxruntime, and all that a network can be loaded for.
OnnxProvider = Literal["cpu", "cuda", "tensorrt"]
Loadable = Literal[OnnxProvider, "openvino"]

# What onnxruntime calls its providers.
NAMES: Final[Mapping[OnnxProvider, str]] = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
}

_TITLES: Final[Mapping[OnnxProvider, str]] = {"cpu": "CPU", "cuda": "CUDA", "tensorrt": "TensorRT"}

# What `auto` tries, the best first, and why it takes it. TensorRT builds engines for minutes: it must be asked for.
# OpenVINO multiplies int8 matrices in AMX's tiles, and is up to half as fast again there; on a CPU without them
# onnxruntime is a little faster (`python tools/providers.py`).
_AUTO_WITH_AMX: Final[Mapping[Loadable, str]] = {
    "cuda": "CUDA can be used",
    "openvino": "OpenVINO is installed, the faster one on a CPU with AMX",
    "cpu": "onnxruntime on the CPU can always be had",
}
_AUTO: Final[Mapping[Loadable, str]] = {
    "cuda": "CUDA can be used",
    "cpu": "onnxruntime is the faster one on a CPU without AMX",
}


@dataclass(frozen=True)
class Offer:
    """What can be had: onnxruntime's providers by its names for them, whether OpenVINO is installed, and whether the
    CPU has AMX.

    That a provider is built in does not mean that it can be used: only the loaded network tells what was got.
    """

    onnxruntime: frozenset[str]
    openvino: bool
    amx: bool


def offered() -> Offer:
    """What can be had here."""
    return Offer(
        onnxruntime=frozenset(onnxruntime.get_available_providers()),
        openvino=find_spec("openvino") is not None,
        amx="amx_int8" in instruction_sets(),
    )


def without_gpus(offer: Offer) -> Offer:
    """The same on a machine without a GPU."""
    return replace(offer, onnxruntime=offer.onnxruntime & {NAMES["cpu"]})


def cuda_version() -> str | None:
    """The version of CUDA that the installed onnxruntime is built for, None where it has none."""
    return onnxruntime.cuda_version or None


def preload_gpu_libraries() -> None:
    """Loads CUDA and cuDNN from Python packages, where the loader would not look; what is missing is told on stderr."""
    with contextlib.redirect_stdout(sys.stderr):
        onnxruntime.preload_dlls()


def attempts(provider: Provider, offer: Offer) -> Mapping[Loadable, str]:
    """The providers to try, in order, each with the reason to take it."""
    if provider != "auto":
        return {provider: f"{provider} was asked for"}
    return _AUTO_WITH_AMX if offer.amx else _AUTO


def require(provider: Loadable, offer: Offer) -> None:
    """Raises ProviderError where nothing that is installed has `provider`."""
    if provider == "openvino":
        if not offer.openvino:
            raise ProviderError(
                "OpenVINO is not installed", "pip install 'lanestream[openvino]', or use the provider auto or cpu"
            )
    elif NAMES[provider] not in offer.onnxruntime:
        raise ProviderError(
            f"the installed onnxruntime has no {_TITLES[provider]}",
            "install lanestream[gpu] instead of [cpu], or use the provider auto or cpu",
        )


def verify(provider: OnnxProvider, got: list[str]) -> None:
    """Raises ProviderError where a session for `provider` came to run on another one of those it `got`.

    onnxruntime falls back in silence, also with its fallback off: only the session itself tells.
    """
    if got[0] != NAMES[provider]:
        raise ProviderError(
            f"{_TITLES[provider]} can't be used: onnxruntime fell back to {got[0]}",
            "check the driver and the libraries with `lanestream doctor`, or use the provider auto or cpu",
        )
