"""Checkpoints of other trainers, however they wrap the weights, are read the same way to train on and to export."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from lanestream.errors import CheckpointError
from lanestream.road.crops import PatchGeometry
from lanestream_exporter.alexnet import AlexNet, Shape, load_torchvision_weights
from lanestream_exporter.exporting.checkpoint import ForeignNetwork, read_network
from lanestream_exporter.exporting.classifier import ExportableClassifier
from lanestream_exporter.weight_files import load_state, weights_in

SHAPE = Shape(size=112, width=0.1, hidden=8)
Weights = dict[str, Tensor]


def prefixed(weights: Weights, prefix: str) -> Weights:
    return {f"{prefix}{key}": value for key, value in weights.items()}


WRAPPINGS: dict[str, Callable[[AlexNet], Any]] = {
    "bare": lambda network: network.state_dict(),
    "model": lambda network: {"model": network.state_dict(), "epoch": 3},
    "weights": lambda network: {"epoch": 3, "weights": network.state_dict()},
    "data parallel": lambda network: nn.DataParallel(network).state_dict(),
    "averaged": lambda network: AveragedModel(network).state_dict(),
    "compiled": lambda network: {"net": prefixed(network.state_dict(), "module._orig_mod.")},
    "nested": lambda network: {"checkpoint": {"state_dict": prefixed(network.state_dict(), "module.")}},
    "lightning": lambda network: {
        "state_dict": {**prefixed(network.state_dict(), "model."), "loss.weight": torch.ones(2)},
        "pytorch-lightning_version": "2.5.0",
        "callbacks": {},
    },
    "torchvision": lambda network: {
        "model": network.state_dict(),
        "optimizer": {"state": {}, "param_groups": [{"lr": 0.1}]},
        "args": Namespace(model="alexnet", lr=0.1),
        "best": np.float64(0.5),
        "history": np.zeros(3),
    },
}


@pytest.fixture
def network() -> AlexNet:
    torch.manual_seed(0)
    return AlexNet(2, SHAPE, batch_norm=False)


@pytest.mark.parametrize("wrapping", WRAPPINGS)
def test_the_weights_are_found_in_every_wrapping(tmp_path: Path, network: AlexNet, wrapping: str) -> None:
    torch.save(WRAPPINGS[wrapping](network), tmp_path / "given.pt")
    found = weights_in(load_state(tmp_path / "given.pt"))
    assert found.keys() == network.state_dict().keys()
    assert all(torch.equal(found[key], value) for key, value in network.state_dict().items())


@pytest.mark.parametrize("wrapping", ["lightning", "nested"])
def test_training_and_export_read_the_same_weights(tmp_path: Path, wrapping: str) -> None:
    torch.manual_seed(1)
    full = AlexNet(2, batch_norm=False)
    torch.save(WRAPPINGS[wrapping](full), tmp_path / "given.pt")
    start = AlexNet(2)
    load_torchvision_weights(start, tmp_path / "given.pt")
    assert torch.equal(start.state_dict()["classifier.4.weight"], full.state_dict()["classifier.4.weight"])
    exportable, _ = read_network(tmp_path / "given.pt", ForeignNetwork(("false", "lane"), PatchGeometry(224)))
    assert isinstance(exportable, ExportableClassifier)
    assert torch.equal(exportable.network.state_dict()["classifier.6.bias"], full.state_dict()["classifier.6.bias"])


def test_the_weights_of_a_run_may_have_the_prefix_of_data_parallel(tmp_path: Path) -> None:
    own = AlexNet(2, SHAPE)
    record = {"config": {"network": {"size": 112, "width": 0.1, "hidden": 8}}}
    torch.save({"network": nn.DataParallel(own).state_dict(), "record": record}, tmp_path / "own.pt")
    assert load_state(tmp_path / "own.pt")["network"].keys() == own.state_dict().keys()
    assert isinstance(read_network(tmp_path / "own.pt")[0], ExportableClassifier)


def test_normalization_layers_are_not_left_at_their_start(tmp_path: Path) -> None:
    own = AlexNet(2, SHAPE)
    own.norms["0"].running_mean.fill_(3.0)  # type: ignore[union-attr, operator]
    torch.save({"state_dict": own.state_dict()}, tmp_path / "own.pt")
    start = AlexNet(9, SHAPE)
    load_torchvision_weights(start, tmp_path / "own.pt")
    assert (start.state_dict()["norms.0.running_mean"] == 3.0).all()


def test_a_whole_network_is_refused_by_the_name_of_its_type(tmp_path: Path, network: AlexNet) -> None:
    torch.save(network, tmp_path / "whole.pt")
    with pytest.raises(CheckpointError, match=r"holds Python objects besides weights, such as .*AlexNet") as caught:
        load_state(tmp_path / "whole.pt")
    assert "state_dict()" in caught.value.hint
