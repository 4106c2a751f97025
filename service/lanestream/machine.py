"""What this machine has to run networks with: its processors, and its GPU with the libraries that it needs."""

from __future__ import annotations

import ctypes
import platform
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from lanestream.inference.providers import cuda_version, preload_gpu_libraries
from lanestream.processors import affinity, cpu_entries, instructions, processors, quota

# Instructions that decide how fast a network is, on x86 and on ARM.
_FLAGS: Final = (
    *("avx2", "avx_vnni", "avx512f", "avx512_vnni", "avx512_bf16", "avx512_fp16", "amx_int8", "amx_bf16"),
    *("asimd", "asimddp", "i8mm", "bf16", "sve"),
)
_QUERY: Final = ("--query-gpu=name,memory.total,driver_version", "--format=csv,noheader")
_SMI_S: Final = 10.0


@dataclass(frozen=True)
class Cpu:
    """The CPU, the processors of it that the scheduler and a container's quota leave, and how many are `used`."""

    name: str
    flags: tuple[str, ...]
    affinity: int
    quota: float | None
    used: int


@dataclass(frozen=True)
class Gpu:
    """NVIDIA's devices, and the versions of what they need; None for what is not there or can't be loaded.

    `driver_cuda` is the newest CUDA that the driver can run, `onnxruntime_cuda` the one that onnxruntime was built for.
    """

    devices: tuple[str, ...]
    driver: str | None
    driver_cuda: str | None
    onnxruntime_cuda: str | None
    cuda: str | None
    cudnn: str | None
    tensorrt: str | None


def cpu() -> Cpu:
    """The CPU of this machine."""
    name = cpu_entries().get("model name") or platform.processor() or platform.machine()
    has = instructions()
    return Cpu(name, tuple(flag for flag in _FLAGS if flag in has), affinity(), quota(), processors())


def gpu() -> Gpu:
    """The GPU of this machine, as far as NVIDIA's tools and libraries tell."""
    devices, driver = _devices()
    preload_gpu_libraries()
    return Gpu(
        devices=devices,
        driver=driver,
        driver_cuda=version_of(("libcuda.so.1",), _driver_cuda),
        onnxruntime_cuda=cuda_version(),
        cuda=version_of(("libcudart.so.13", "libcudart.so.12"), _cuda),
        cudnn=version_of(("libcudnn.so.9",), _cudnn),
        tensorrt=version_of(("libnvinfer.so.11", "libnvinfer.so.10"), _tensorrt),
    )


def version_of(
    names: tuple[str, ...], ask: Callable[[Any], str], load: Callable[[str], Any] = ctypes.CDLL
) -> str | None:
    """The version that the first library of `names` that can be loaded tells of itself, None where none can be."""
    for name in names:
        try:
            return ask(load(name))
        except (OSError, AttributeError):
            continue
    return None


def _devices() -> tuple[tuple[str, ...], str | None]:
    """The devices with their memory, and the driver's version."""
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return (), None
    try:
        done = subprocess.run(  # noqa: S603
            [tool, *_QUERY], capture_output=True, text=True, timeout=_SMI_S, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return (), None
    rows = [[field.strip() for field in line.split(",")] for line in done.stdout.splitlines() if line.count(",") == 2]
    return tuple(f"{name}, {memory}" for name, memory, _ in rows), rows[0][2] if rows else None


def _driver_cuda(library: Any) -> str:
    return _thousands(_written(library.cuDriverGetVersion))


def _cuda(library: Any) -> str:
    return _thousands(_written(library.cudaRuntimeGetVersion))


def _cudnn(library: Any) -> str:
    library.cudnnGetVersion.restype = ctypes.c_size_t
    number = library.cudnnGetVersion()
    return f"{number // 10000}.{number // 100 % 100}.{number % 100}"


def _tensorrt(library: Any) -> str:
    number = library.getInferLibVersion()
    return f"{number // 10000}.{number // 100 % 100}.{number % 100}"


def _written(function: Any) -> int:
    """What `function` writes to the integer it is given."""
    number = ctypes.c_int()
    function(ctypes.byref(number))
    return number.value


def _thousands(number: int) -> str:
    return f"{number // 1000}.{number % 1000 // 10}"
