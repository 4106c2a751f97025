"""What a machine has to run networks with, told by stand-ins for tools and libraries that are not here."""

import ctypes
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from lanestream import machine


def writes(number: int) -> Any:
    """A function of CUDA's kind: the version goes to where its argument points."""

    def function(target: Any) -> int:
        ctypes.cast(target, ctypes.POINTER(ctypes.c_int))[0] = number
        return 0

    return function


def library_of(names: tuple[str, ...]) -> Any:
    """A loader that has the libraries `names`, all of them with every function."""

    def load(name: str) -> Any:
        if name not in names:
            raise OSError(name)
        return SimpleNamespace(
            cuDriverGetVersion=writes(13020),
            cudaRuntimeGetVersion=writes(13000),
            getInferLibVersion=lambda: 101401,
        )

    return load


class Function:
    """Stands in for a function of a C library, whose type of result can be set."""

    restype: Any = None

    def __call__(self) -> int:
        return 91302


@pytest.mark.parametrize(
    ("wanted", "ask", "version"),
    [
        ("libcuda.so.1", machine._driver_cuda, "13.2"),
        ("libcudart.so.12", machine._cuda, "13.0"),
        ("libnvinfer.so.10", machine._tensorrt, "10.14.1"),
    ],
)
def test_versions_are_read_as_their_libraries_tell_them(wanted: str, ask: Any, version: str) -> None:
    names = ("libnone.so.9", wanted)
    assert machine.version_of(names, ask, library_of((wanted,))) == version
    assert machine.version_of(names, ask, library_of(())) is None


def test_the_version_of_cudnn_is_a_size() -> None:
    library = SimpleNamespace(cudnnGetVersion=Function())
    assert machine.version_of(("libcudnn.so.9",), machine._cudnn, lambda _: library) == "9.13.2"
    assert library.cudnnGetVersion.restype is ctypes.c_size_t


def test_a_library_without_the_function_is_none() -> None:
    assert machine.version_of(("libc.so.6",), machine._driver_cuda) is None


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
def test_devices_are_those_that_nvidia_smi_tells(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, devices: tuple[str, ...], driver: str | None
) -> None:
    tool = tmp_path / "nvidia-smi"
    tool.write_text(f"#!/bin/sh\n{script}\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    found = machine.gpu()
    assert (found.devices, found.driver) == (devices, driver)


def test_the_cpu_is_this_one() -> None:
    cpu = machine.cpu()
    assert cpu.name
    assert 1 <= cpu.used <= cpu.affinity
    assert len(set(cpu.flags)) == len(cpu.flags)
