"""Choosing an execution provider, and saying honestly which one was got."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal

import onnxruntime

from lanestream.errors import ProviderError

Provider = Literal["auto", "cpu", "cuda"]

_CPU, _CUDA = "CPUExecutionProvider", "CUDAExecutionProvider"


@dataclass(frozen=True)
class Choice:
    """The providers to ask for, in order, and why."""

    names: tuple[str, ...]
    reason: str


def choose(provider: Provider) -> Choice:
    """What to ask for. Raises ProviderError where CUDA is required and this build of onnxruntime has none.

    A build that lists CUDA may still fail to load it: only the session that was created tells what was got.
    """
    built_in = _CUDA in onnxruntime.get_available_providers()
    if provider == "cpu":
        return Choice((_CPU,), "the CPU was asked for")
    if built_in:
        onnxruntime.preload_dlls()
    if provider == "cuda":
        if not built_in:
            raise ProviderError(
                "CUDA was asked for, and the installed onnxruntime has none",
                "install lanestream[gpu] instead of [cpu], or use the provider auto or cpu",
            )
        return Choice((_CUDA,), "CUDA was asked for")
    if built_in:
        return Choice((_CUDA, _CPU), "CUDA is tried first")
    return Choice((_CPU,), "the installed onnxruntime has no CUDA")


def cpu_threads() -> int:
    """How many threads this process may really run at a time."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def verify(provider: Provider, got: list[str]) -> str:
    """The provider that runs the session, of those it `got`. Raises ProviderError where CUDA was required in vain."""
    if provider == "cuda" and got[0] != _CUDA:
        raise ProviderError(
            f"CUDA was asked for, and onnxruntime fell back to {got[0]}",
            "check the driver and the CUDA libraries, or use the provider auto",
        )
    return got[0].removesuffix("ExecutionProvider").lower()
