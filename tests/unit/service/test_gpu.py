"""GPU devices and library versions, read from fakes of the tool and the libraries."""

import ctypes
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from lanestream import gpu


def writes(number: int) -> Any:
    """Returns a function like CUDA's, which writes the version to where its argument points."""

    def function(target: Any) -> int:
        ctypes.cast(target, ctypes.POINTER(ctypes.c_int))[0] = number
        return 0

    return function


def loader(names: tuple[str, ...]) -> Any:
    """Returns a function that loads the libraries `names`, each of which has every function."""

    def load(name: str) -> Any:
        if name not in names:
            raise OSError(name)
        return SimpleNamespace(
            cuDriverGetVersion=writes(13020),
            cudaRuntimeGetVersion=writes(13000),
            getInferLibVersion=lambda: 101401,
        )

    return load


class CFunction:
    """A fake function of a C library, whose result type can be set."""

    restype: Any = None

    def __call__(self) -> int:
        return 91302


@pytest.mark.parametrize(
    ("installed", "read", "version"),
    [
        ("libcuda.so.1", gpu._driver_cuda_version, "13.2"),
        ("libcudart.so.12", gpu._cuda_version, "13.0"),
        ("libnvinfer.so.10", gpu._tensorrt_version, "10.14.1"),
    ],
)
def test_the_first_installed_library_gives_the_version(installed: str, read: Any, version: str) -> None:
    names = ("libnone.so.9", installed)
    assert gpu.library_version(names, read, loader((installed,))) == version
    assert gpu.library_version(names, read, loader(())) is None


def test_the_cudnn_version_is_read_as_a_size() -> None:
    library = SimpleNamespace(cudnnGetVersion=CFunction())
    assert gpu.library_version(("libcudnn.so.9",), gpu._cudnn_version, lambda _: library) == "9.13.2"
    assert library.cudnnGetVersion.restype is ctypes.c_size_t


def test_a_library_without_the_function_has_no_version() -> None:
    assert gpu.library_version(("libc.so.6",), gpu._driver_cuda_version) is None


@pytest.mark.parametrize(
    ("script", "devices", "driver"),
    [
        (
            "echo 'NVIDIA H200, 143771 MiB, 580.95.05'; echo 'NVIDIA L4, 23034 MiB, 580.95.05'",
            ("NVIDIA H200, 143771 MiB", "NVIDIA L4, 23034 MiB"),
            "580.95.05",
        ),
        ("echo 'No devices were found'", (), None),
        ("echo 'NVIDIA-SMI has failed because it could not talk to the driver'; exit 9", (), None),
    ],
)
def test_devices_and_driver_come_from_nvidia_smi(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, devices: tuple[str, ...], driver: str | None
) -> None:
    tool = tmp_path / "nvidia-smi"
    tool.write_text(f"#!/bin/sh\n{script}\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    found = gpu.gpu()
    assert (found.devices, found.driver) == (devices, driver)
