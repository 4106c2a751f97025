"""Reading the weights of networks from PyTorch files, however a trainer wrapped them. No code of the files runs."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from lanestream.errors import CheckpointError

# A key of every network of this project, by which its weights are found.
_FIRST_WEIGHT: Final = "features.0.weight"
# The functions that make numbers and arrays from what NumPy stores.
_SCALAR: Final[Any] = np.float64().__reduce__()[0]
_ARRAY: Final[Any] = np.empty(0).__reduce__()[0]
# What other trainers store next to the weights: arguments and figures. Reading these types runs no code.
_HARMLESS: Final[list[Callable[..., Any] | tuple[Callable[..., Any], str]]] = [
    Namespace,
    np.dtype,
    np.ndarray,
    *(type(np.dtype(name)) for name in ("bool", "int32", "int64", "float32", "float64")),
    # By the names that NumPy 1 and NumPy 2 give them.
    *((_SCALAR, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")),
    *((_ARRAY, f"numpy.{core}.multiarray._reconstruct") for core in ("core", "_core")),
]


def load_state(path: Path) -> dict[str, Any]:
    """Returns the dictionary in a PyTorch file without running code from it. Raises CheckpointError with one line.

    The weights of a run, its `network`, have the names that the network gives them, as `weights_in` explains.
    """
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}", "give the path of a .pt file")
    try:
        with torch.serialization.safe_globals(_HARMLESS):
            state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load raises many types, with pages of advice, for other files
        objects = _objects_in(path)
        if objects:
            message = f"{path} holds Python objects besides weights, such as {objects[0]}"
            raise CheckpointError(message, "save network.state_dict() with torch.save") from error
        raise CheckpointError(f"{path} is not a PyTorch checkpoint", "give a file that holds only weights") from error
    if not isinstance(state, dict):
        raise CheckpointError(f"{path} holds a {type(state).__name__}", "give a file that holds a state_dict")
    if isinstance(state.get("network"), Mapping):
        state["network"] = weights_in(state["network"])
    return state


def weights_in(state: Mapping[str, Any]) -> dict[str, Tensor]:
    """Returns the network's weights in what a trainer saved, by the names that the network itself gives them.

    The weights may lie in an inner dictionary, such as `state_dict` or `model`, and their names may have prefixes, such
    as `module.` of DataParallel, `_orig_mod.` of torch.compile or the name of the network in a larger module. Of
    several networks the first is taken. Without any, all tensors at the top are returned.
    """
    for inner in _dictionaries_in(state):
        first = next((key for key in inner if str(key).endswith(_FIRST_WEIGHT)), None)
        prefix = None if first is None else str(first).removesuffix(_FIRST_WEIGHT)
        if prefix is not None and (not prefix or prefix.endswith(".")):
            return {key.removeprefix(prefix): value for key, value in _tensors(inner).items() if key.startswith(prefix)}
    return _tensors(state)


def _dictionaries_in(state: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yields a dictionary and all that it holds, at any depth."""
    yield state
    for value in state.values():
        if isinstance(value, Mapping):
            yield from _dictionaries_in(value)


def _tensors(state: Mapping[str, Any]) -> dict[str, Tensor]:
    return {str(key): value for key, value in state.items() if isinstance(value, Tensor)}


def _objects_in(path: Path) -> list[str]:
    """Returns the types of Python objects in a PyTorch file that are not read; none if it is not one."""
    try:
        with torch.serialization.safe_globals(_HARMLESS):
            return sorted(torch.serialization.get_unsafe_globals_in_checkpoint(path))
    except Exception:  # whatever is wrong with the file, reading it reported that before
        return []
