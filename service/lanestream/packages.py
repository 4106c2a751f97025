"""Installed packages that own the same module: pip lets them overwrite each other's files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from importlib.metadata import PackageNotFoundError, version
from traceback import walk_tb
from types import ModuleType
from typing import Final

# The packages that install a module, the preferred one first.
_OWNERS: Final[Mapping[str, tuple[str, ...]]] = {
    "cv2": (
        *("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python"),
        *("opencv-python-rolling", "opencv-python-headless-rolling", "opencv-contrib-python-rolling"),
    ),
    "onnxruntime": (
        *("onnxruntime-gpu", "onnxruntime", "onnxruntime-openvino", "onnxruntime-directml", "onnxruntime-rocm"),
        *("onnxruntime-migraphx", "onnxruntime-qnn", "onnxruntime-training", "ort-nightly", "ort-nightly-gpu"),
    ),
}


def installed_versions(names: Iterable[str]) -> dict[str, str]:
    """Returns the versions of those packages that are installed."""
    versions = {}
    for name in names:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


def owner_versions(module: str) -> dict[str, str]:
    """Returns the versions of the installed packages that own `module`, the preferred package first."""
    return installed_versions(_OWNERS.get(module, ()))


def package_conflicts() -> tuple[str, ...]:
    """Returns a line for every module that several installed packages own: what is installed and what to do."""
    found = []
    for module in _OWNERS:
        versions = owner_versions(module)
        if len(versions) > 1:
            names = " and ".join(f"{name} {number}" for name, number in versions.items())
            found.append(f"{names} are both the module {module}, so that one overwrites the other; {_repair(module)}")
    return tuple(found)


def broken_module(error: ImportError | AttributeError) -> tuple[str, str] | None:
    """Returns the installed module that can't be used, as `error` shows, and what to do; None if it shows none.

    What a module lacks may have been removed with another package that owned it, too.
    """
    if isinstance(error, ImportError):
        name = error.name or _innermost_module(error)
    else:
        name = error.obj.__name__ if isinstance(error.obj, ModuleType) else ""
    module = name.partition(".")[0]
    return (module, _repair(module)) if module and not module.startswith("lanestream") else None


def _innermost_module(error: ImportError) -> str:
    """Returns the module that raised an error without a name, as extensions do that were built for another NumPy."""
    names = [str(frame.f_globals.get("__name__", "")) for frame, _ in walk_tb(error.__traceback__)]
    return next((name for name in reversed(names) if not name.startswith("importlib")), "")


def _repair(module: str) -> str:
    installed = list(owner_versions(module)) or list(_OWNERS.get(module, (module,)))[:1]
    return f"`pip uninstall {' '.join(installed)}`, then `pip install {installed[0]}`"
