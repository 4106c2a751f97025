"""Reading a checkpoint for export: one of this project's networks, or a torchvision AlexNet from elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from pydantic import ValidationError
from torch import Tensor, nn

from lanestream.errors import CheckpointError
from lanestream.road.appearance import BOUNDARY_KINDS
from lanestream.road.crops import PatchGeometry
from lanestream_exporter.alexnet import FULL, OUTPUTS, AlexNet, Shape
from lanestream_exporter.exporting.classifier import ExportableClassifier
from lanestream_exporter.exporting.exportable import ExportableNetwork
from lanestream_exporter.exporting.regressor import ExportableRegressor
from lanestream_exporter.regressor import LaneRegressor
from lanestream_exporter.training.config import NetworkSize
from lanestream_exporter.weight_files import load_state, weights_in

_LANE: Final = "lane"
_LAST_LAYER: Final = "classifier.6.weight"


@dataclass(frozen=True)
class ForeignNetwork:
    """What a checkpoint from elsewhere does not record: its `classes` in order, its patches and pixel normalization."""

    classes: tuple[str, ...]
    patch_geometry: PatchGeometry
    normalization: str = "imagenet"


def read_network(path: Path, foreign: ForeignNetwork | None = None) -> tuple[ExportableNetwork, dict[str, Any]]:
    """Reads the network in the checkpoint at `path` and the record of its training, without executing code from it.

    Give `foreign` for a plain AlexNet with torchvision's key names; a checkpoint of this project's trainer records
    everything itself. Raises CheckpointError if the file holds neither.
    """
    state = load_state(path)
    if "network" in state:
        if foreign is not None:
            raise CheckpointError(f"{path} is a checkpoint of this trainer", "remove --classes and --patch")
        return _read_own(path, state), _training_record(state)
    weights = _unwrap(path, state)
    if foreign is None:
        raise CheckpointError(
            f"{path} is not a checkpoint of this trainer",
            "give the best.pt of a run; for a torchvision AlexNet, also give --classes and --patch",
        )
    record = {"data": "not recorded", "source": "a torchvision AlexNet from elsewhere"}
    return _read_foreign(path, weights, foreign), record


def _read_own(path: Path, state: Mapping[str, Any]) -> ExportableNetwork:
    weights = state["network"]
    shape = _recorded_shape(path, state)
    if "column_head.0.weight" in weights:
        regressor = LaneRegressor(shape, batch_norm=_has_norms(weights))
        _load_weights(path, regressor, weights)
        return ExportableRegressor(regressor.eval().folded())
    network = _load_alexnet(path, weights, shape)
    # Runs before 0.13 have two classes.
    classes = ("nothing", *BOUNDARY_KINDS) if network.outputs == OUTPUTS else ("false", _LANE)
    return ExportableClassifier(network, classes, PatchGeometry(shape.size))


def _recorded_shape(path: Path, state: Mapping[str, Any]) -> Shape:
    """Returns the network size that the run recorded; older runs recorded none and used the full AlexNet."""
    config = (state.get("record") or {}).get("config") or {}
    if "network" not in config:
        return FULL
    try:
        return NetworkSize.model_validate(config["network"]).shape
    except ValidationError:
        hint = "give an unmodified best.pt of the trainer"
        raise CheckpointError(f"{path} does not record a valid network size", hint) from None


def _read_foreign(path: Path, weights: Mapping[str, Tensor], foreign: ForeignNetwork) -> ExportableClassifier:
    classes, geometry = foreign.classes, foreign.patch_geometry
    if len(classes) != 2 or _LANE not in classes:
        raise CheckpointError(
            f"the classes {', '.join(classes)} can't be served",
            f"give two classes in the network's order, one of them {_LANE}",
        )
    if geometry.size != FULL.size:
        raise CheckpointError(
            f"patches of size {geometry.size} don't fit AlexNet", f"its first hidden layer takes size {FULL.size}"
        )
    network = _load_alexnet(path, weights, FULL)
    other = classes[1 - classes.index(_LANE)]
    if classes[0] == _LANE:  # the service expects the lane's probability second
        last = network.classifier[6]
        assert isinstance(last, nn.Linear)  # noqa: S101 - for mypy; AlexNet's constructor guarantees it
        last.weight.data, last.bias.data = last.weight.data.flip(0), last.bias.data.flip(0)
    return ExportableClassifier(network, (other, _LANE), geometry, foreign.normalization)


def _load_alexnet(path: Path, weights: Mapping[str, Tensor], shape: Shape) -> AlexNet:
    last = weights.get(_LAST_LAYER)
    if not isinstance(last, Tensor) or last.ndim != 2:
        raise CheckpointError(f"{path} is not an AlexNet: {_LAST_LAYER} is missing", "use torchvision's key names")
    if len(last) not in (2, OUTPUTS):
        raise CheckpointError(
            f"{path} has {len(last)} outputs, but the service needs {OUTPUTS}, or 2 of a network from elsewhere",
            "train it with `lanestream train classifier`, or fine-tune it with a final layer of 2",
        )
    network = AlexNet(len(last), shape, batch_norm=_has_norms(weights))
    _load_weights(path, network, weights)
    return network.eval().folded()


def _load_weights(path: Path, network: nn.Module, weights: Mapping[str, Tensor]) -> None:
    """Loads `weights` into `network`. Raises CheckpointError if a key or a shape differs or a value is not finite."""
    expected = network.state_dict()
    hint = "give a checkpoint of this trainer, or a torchvision AlexNet"
    for key, value in expected.items():
        if key not in weights:
            raise CheckpointError(f"{path} lacks {key}", hint)
        if weights[key].shape != value.shape:
            shapes = f"{tuple(weights[key].shape)}, expected {tuple(value.shape)}"
            raise CheckpointError(f"{path}: {key} has the shape {shapes}", hint)
    if unknown := sorted(weights.keys() - expected.keys()):
        raise CheckpointError(f"{path} has {unknown[0]}, which this network does not have", hint)
    network.load_state_dict(dict(weights))
    if not all(bool(torch.isfinite(value).all()) for value in network.state_dict().values()):
        raise CheckpointError(f"{path} has weights that are not finite", "use an earlier checkpoint of the run")


def _unwrap(path: Path, state: Mapping[str, Any]) -> Mapping[str, Tensor]:
    """Returns the bare weights, wherever a trainer stored them. Raises CheckpointError if there are none."""
    weights = weights_in(state)
    if not weights:
        raise CheckpointError(f"{path} has no weights", "save the state_dict of the network")
    return weights


def _has_norms(weights: Mapping[str, Tensor]) -> bool:
    return any(key.startswith("norms.") for key in weights)


def _training_record(state: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what the trainer recorded: step, validation figures, data, configuration, revision."""
    record = state.get("record") or {}
    known = {key: record[key] for key in ("revision", "lanestream", "torch", "data", "config") if key in record}
    return {"data": "not recorded", **known, "step": state.get("step"), "figures": state.get("figures", {})}
