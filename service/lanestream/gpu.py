"""NVIDIA GPUs, and the versions of the driver and of the libraries that the CUDA and TensorRT providers need."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from lanestream.inference.onnx_model import preload_gpu_libraries
from lanestream.inference.providers import cuda_version

_QUERY: Final = ("--query-gpu=name,memory.total,driver_version", "--format=csv,noheader")
_NVIDIA_SMI_TIMEOUT_S: Final = 10.0


@dataclass(frozen=True)
class Gpu:
    """The NVIDIA devices and library versions; None for a library that is missing or can't be loaded.

    `driver_cuda` is the newest CUDA version that the driver supports, `onnxruntime_cuda` the one that onnxruntime was
    built for.
    """

    devices: tuple[str, ...]
    driver: str | None
    driver_cuda: str | None
    onnxruntime_cuda: str | None
    cuda: str | None
    cudnn: str | None
    tensorrt: str | None


def gpu() -> Gpu:
    """Returns the devices and the versions, read from nvidia-smi and from the libraries themselves."""
    devices, driver = _devices()
    preload_gpu_libraries()
    return Gpu(
        devices=devices,
        driver=driver,
        driver_cuda=library_version(("libcuda.so.1",), _driver_cuda_version),
        onnxruntime_cuda=cuda_version(),
        cuda=library_version(("libcudart.so.13", "libcudart.so.12"), _cuda_version),
        cudnn=library_version(("libcudnn.so.9",), _cudnn_version),
        tensorrt=library_version(("libnvinfer.so.11", "libnvinfer.so.10"), _tensorrt_version),
    )


def library_version(
    names: tuple[str, ...], read: Callable[[Any], str], load: Callable[[str], Any] = ctypes.CDLL
) -> str | None:
    """Returns the version of the first library in `names` that can be loaded and read, or None."""
    for name in names:
        try:
            return read(load(name))
        except (OSError, AttributeError):
            continue
    return None


def _devices() -> tuple[tuple[str, ...], str | None]:
    """Returns the devices with their memory, and the driver's version."""
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return (), None
    try:
        result = subprocess.run(  # noqa: S603
            [tool, *_QUERY], capture_output=True, text=True, timeout=_NVIDIA_SMI_TIMEOUT_S, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return (), None
    rows = [[field.strip() for field in line.split(",")] for line in result.stdout.splitlines() if line.count(",") == 2]
    return tuple(f"{name}, {memory}" for name, memory, _ in rows), rows[0][2] if rows else None


def _driver_cuda_version(library: Any) -> str:
    return _cuda_format(_read_integer(library.cuDriverGetVersion))


def _cuda_version(library: Any) -> str:
    return _cuda_format(_read_integer(library.cudaRuntimeGetVersion))


def _cudnn_version(library: Any) -> str:
    library.cudnnGetVersion.restype = ctypes.c_size_t
    return _three_part_format(library.cudnnGetVersion())


def _tensorrt_version(library: Any) -> str:
    return _three_part_format(library.getInferLibVersion())


def _read_integer(function: Any) -> int:
    """Returns the integer that a C function writes to its only argument, a pointer."""
    number = ctypes.c_int()
    function(ctypes.byref(number))
    return number.value


def _cuda_format(number: int) -> str:
    return f"{number // 1000}.{number % 1000 // 10}"


def _three_part_format(number: int) -> str:
    return f"{number // 10000}.{number // 100 % 100}.{number % 100}"
