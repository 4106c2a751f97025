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
_AUTO: Final[Mapping[Loadable, str]] = {
    "cuda": "CUDA can be used",
    "openvino": "OpenVINO is installed",
    "cpu": "onnxruntime on the CPU can always be had",
}


@dataclass(frozen=True)
class Offer:
    """What the installed packages have: onnxruntime's providers by its names for them, and whether OpenVINO is there.

    That a provider is built in does not mean that it can be used: only the loaded network tells what was got.
    """

    onnxruntime: frozenset[str]
    openvino: bool


def offered() -> Offer:
    """What is installed here."""
    return Offer(frozenset(onnxruntime.get_available_providers()), find_spec("openvino") is not None)


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


def attempts(provider: Provider) -> Mapping[Loadable, str]:
    """The providers to try, in order, each with the reason to take it."""
    return _AUTO if provider == "auto" else {provider: f"{provider} was asked for"}


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
