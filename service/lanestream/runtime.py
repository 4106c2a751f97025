"""The options for running networks. Cheap to import: it imports no inference runtime."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, get_args

Provider = Literal["auto", "cpu", "cuda", "tensorrt", "openvino"]
PROVIDERS: Final[tuple[Provider, ...]] = get_args(Provider)


@dataclass(frozen=True)
class RuntimeOptions:
    """How networks run: `threads` per run on the CPU, or one per available processor if None.

    `engine_cache` is the folder where TensorRT keeps the engines that it built; if None, it builds them at each start.
    """

    threads: int | None = None
    engine_cache: Path | None = None


DEFAULT_OPTIONS: Final = RuntimeOptions()
