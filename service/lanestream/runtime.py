"""What users can say about where networks run. Light: no runtime is imported here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, get_args

Provider = Literal["auto", "cpu", "cuda", "tensorrt", "openvino"]
PROVIDERS: Final[tuple[Provider, ...]] = get_args(Provider)


@dataclass(frozen=True)
class RuntimeOptions:
    """How networks run: `threads` of one run on the CPU, one for each processor that may be used where None.

    `engine_cache` is the folder where TensorRT keeps the engines that it built; None builds them at each start.
    """

    threads: int | None = None
    engine_cache: Path | None = None


DEFAULT_OPTIONS: Final = RuntimeOptions()
