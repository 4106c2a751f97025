"""Which network a checkpoint holds, this project's own or a torchvision AlexNet from elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from pydantic import ValidationError
from torch import Tensor, nn

from lanestream.detection.patches import PatchGeometry
from lanestream.errors import CheckpointError
from lanestream_exporter.alexnet import FULL, AlexNet, Shape, load_state
from lanestream_exporter.exporting.classifier import ClassifierSubject
from lanestream_exporter.exporting.regressor import RegressorSubject
from lanestream_exporter.exporting.subject import Subject
from lanestream_exporter.regressor import LaneRegressor
from lanestream_exporter.training.config import NetworkSize

_LANE: Final = "lane"
_LAST: Final = "classifier.6.weight"

# Under one of these other trainers keep the weights.
_WRAPPED: Final = ("model", "state_dict", "model_state_dict")


@dataclass(frozen=True)
class Foreign:
    """What a checkpoint from elsewhere doesn't say: its `classes` in order, its strips, its pixels' normalisation."""

    classes: tuple[str, ...]
    strip: PatchGeometry
    normalisation: str = "imagenet"


def read_subject(path: Path, foreign: Foreign | None = None) -> tuple[Subject, dict[str, Any]]:
    """The network in the checkpoint at `path`, ready to be exported, and what is known of its training.

    No code of the file is run. `foreign` is for a plain AlexNet of torchvision's key names; a checkpoint of this
    project's trainer tells everything itself. Raises CheckpointError where the file holds neither.
    """
    state = load_state(path)
    if "network" in state:
        if foreign is not None:
            raise CheckpointError(f"{path} is a checkpoint of this trainer", "leave --classes and --strip off")
        return _own(path, state), _training(state)
    weights = _unwrapped(path, state)
    if foreign is None:
        raise CheckpointError(
            f"{path} is no checkpoint of this trainer",
            "give the best.pt of a run, or, for a torchvision AlexNet, --classes and --strip",
        )
    return _foreign(path, weights, foreign), {"data": "not recorded", "source": "a torchvision AlexNet from elsewhere"}


def _own(path: Path, state: Mapping[str, Any]) -> Subject:
    weights = state["network"]
    shape = _recorded_shape(path, state)
    if "column_head.0.weight" in weights:
        regressor = LaneRegressor(shape, batch_norm=_has_norms(weights))
        _load(path, regressor, weights)
        return RegressorSubject(regressor.eval().folded())
    return ClassifierSubject(_alexnet(path, weights, shape), strip=PatchGeometry(shape.size))


def _recorded_shape(path: Path, state: Mapping[str, Any]) -> Shape:
    """How large the run made its network; runs that did not record it made the whole AlexNet."""
    config = (state.get("record") or {}).get("config") or {}
    if "network" not in config:
        return FULL
    try:
        return NetworkSize.model_validate(config["network"]).shape
    except ValidationError:
        hint = "give a best.pt as the trainer wrote it"
        raise CheckpointError(f"{path} does not say how large its network is", hint) from None


def _foreign(path: Path, weights: Mapping[str, Tensor], foreign: Foreign) -> ClassifierSubject:
    classes = foreign.classes
    if len(classes) != 2 or _LANE not in classes:
        raise CheckpointError(
            f"the classes {', '.join(classes)} can't be served", f"two are, one of them {_LANE}, in the network's order"
        )
    if foreign.strip.size != FULL.size:
        raise CheckpointError(
            f"strips of size {foreign.strip.size} don't fit AlexNet", f"its first hidden layer takes {FULL.size}"
        )
    network = _alexnet(path, weights, FULL)
    other = classes[1 - classes.index(_LANE)]
    if classes[0] == _LANE:  # the service reads the lane's probability second
        last = network.classifier[6]
        assert isinstance(last, nn.Linear)  # noqa: S101 - tells mypy what AlexNet's constructor says
        last.weight.data, last.bias.data = last.weight.data.flip(0), last.bias.data.flip(0)
    return ClassifierSubject(network, (other, _LANE), foreign.strip, foreign.normalisation)


def _alexnet(path: Path, weights: Mapping[str, Tensor], shape: Shape) -> AlexNet:
    last = weights.get(_LAST)
    if not isinstance(last, Tensor) or last.ndim != 2:
        raise CheckpointError(f"{path} holds no AlexNet: there is no {_LAST}", "its keys must be torchvision's")
    if len(last) != 2:
        raise CheckpointError(
            f"{path} tells {len(last)} classes apart, and the service knows two", "fine-tune it with a last layer of 2"
        )
    network = AlexNet(shape=shape, batch_norm=_has_norms(weights))
    _load(path, network, weights)
    return network.eval().folded()


def _load(path: Path, network: nn.Module, weights: Mapping[str, Tensor]) -> None:
    """Takes over `weights` if they fit in every key and shape."""
    wanted = network.state_dict()
    hint = "give a checkpoint of this trainer, or a torchvision AlexNet"
    for key, value in wanted.items():
        if key not in weights:
            raise CheckpointError(f"{path} lacks {key}", hint)
        if weights[key].shape != value.shape:
            shapes = f"{tuple(weights[key].shape)}, not {tuple(value.shape)}"
            raise CheckpointError(f"{path}: {key} has the shape {shapes}", hint)
    if unknown := sorted(weights.keys() - wanted.keys()):
        raise CheckpointError(f"{path} has {unknown[0]}, which this network lacks", hint)
    network.load_state_dict(dict(weights))
    if not all(bool(torch.isfinite(value).all()) for value in network.state_dict().values()):
        raise CheckpointError(f"{path} holds weights that are no numbers", "take an earlier checkpoint of the run")


def _unwrapped(path: Path, state: Mapping[str, Any]) -> Mapping[str, Tensor]:
    """The weights alone, whatever they are wrapped in; DataParallel's prefix goes."""
    inner = next((state[key] for key in _WRAPPED if isinstance(state.get(key), Mapping)), state)
    weights = {str(key).removeprefix("module."): value for key, value in inner.items() if isinstance(value, Tensor)}
    if not weights:
        raise CheckpointError(f"{path} holds no weights", "save the state_dict of the network")
    return weights


def _has_norms(weights: Mapping[str, Tensor]) -> bool:
    return any(key.startswith("norms.") for key in weights)


def _training(state: Mapping[str, Any]) -> dict[str, Any]:
    """What the trainer recorded: steps, validation figures, data, configuration, revision."""
    record = state.get("record") or {}
    told = {key: record[key] for key in ("revision", "lanestream", "torch", "data", "config") if key in record}
    return {"data": "not recorded", **told, "step": state.get("step"), "figures": state.get("figures", {})}
