"""Reading checkpoints for export: this trainer's own, torchvision's AlexNet from elsewhere, and invalid ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from lanestream.errors import CheckpointError
from lanestream.road.crops import PatchGeometry
from lanestream_exporter.alexnet import AlexNet, Shape, load_torchvision_weights
from lanestream_exporter.exporting.checkpoint import ForeignNetwork, read_network
from lanestream_exporter.exporting.classifier import ExportableClassifier
from lanestream_exporter.exporting.exportable import ExportDescription
from lanestream_exporter.training.run_files import read_checkpoint

Weights = dict[str, Tensor]

FOREIGN = ForeignNetwork(("false", "lane"), PatchGeometry(224, half_width=0.4))


def compact(weights: Weights) -> Weights:
    """Returns weights whose largest layers repeat one row, which is stored once: files of megabytes, not hundreds."""
    large = {name: weight[:1].clone().expand_as(weight) for name, weight in weights.items() if weight.numel() > 1 << 22}
    return weights | large


@pytest.fixture(scope="module")
def foreign_network() -> AlexNet:
    """Returns torchvision's network, fine-tuned to two classes."""
    torch.manual_seed(0)
    network = AlexNet(2, batch_norm=False).eval()
    network.load_state_dict(compact(network.state_dict()))
    return network


@pytest.fixture(scope="module")
def foreign_weights(foreign_network: AlexNet) -> Weights:
    """Returns its weights as torchvision saves them."""
    return compact(foreign_network.state_dict())


@pytest.fixture
def saved(tmp_path: Path) -> Any:
    def save(content: object) -> Path:
        path = tmp_path / "given.pt"
        torch.save(content, path)
        return path

    return save


def test_invalid_checkpoints_are_rejected(tmp_path: Path) -> None:
    text = tmp_path / "text.pt"
    text.write_text("not a checkpoint")
    other = tmp_path / "other.pt"
    torch.save({"weights": torch.zeros(3)}, other)
    for path in (text, other, tmp_path / "missing.pt"):
        with pytest.raises(CheckpointError):
            read_checkpoint(path)
        with pytest.raises(CheckpointError):
            load_torchvision_weights(AlexNet(), path)
        for foreign in (None, FOREIGN):
            with pytest.raises(CheckpointError) as caught:
                read_network(path, foreign)
            assert "\n" not in str(caught.value)
            assert caught.value.hint


def test_torchvision_weights_initialize_the_network(tmp_path: Path) -> None:
    path = tmp_path / "alexnet.pt"
    source = compact(AlexNet(1000, batch_norm=False).state_dict())
    torch.save(source, path)
    network = AlexNet()
    load_torchvision_weights(network, path)
    assert torch.equal(network.features[3].weight, source["features.3.weight"])  # type: ignore[arg-type]
    assert network.outputs == 9


def test_the_training_record_is_kept(saved: Any) -> None:
    record = {"revision": "abc", "data": {"rendered": 3}, "config": {"seed": 1}, "torch": "2", "lanestream": "0"}
    state = {"network": compact(AlexNet().state_dict()), "step": 7, "figures": {"validation": 0.25}, "record": record}
    exportable, training = read_network(saved(state))
    assert isinstance(exportable, ExportableClassifier)
    assert exportable.normalization == "contrast"
    assert training == {**record, "step": 7, "figures": {"validation": 0.25}}


@pytest.mark.parametrize("outputs", [2, 9])
def test_a_network_keeps_its_outputs(saved: Any, outputs: int) -> None:
    shape = Shape(size=112, width=0.1, hidden=8)
    record = {"config": {"network": {"size": 112, "width": 0.1, "hidden": 8}}}
    exportable, _ = read_network(saved({"network": AlexNet(outputs, shape).state_dict(), "record": record}))
    assert isinstance(exportable, ExportableClassifier)
    assert exportable.network.outputs == outputs
    described = exportable.info(ExportDescription("own", "1", "fp32", {}, {}))
    assert described.outputs == outputs
    assert len(described.types) == (4 if outputs == 9 else 0)


def test_the_network_has_the_recorded_size(saved: Any) -> None:
    shape = Shape(size=112, width=0.25, hidden=32)
    record = {"config": {"network": {"size": 112, "width": 0.25, "hidden": 32}}}
    exportable, _ = read_network(saved({"network": AlexNet(shape=shape).state_dict(), "record": record}))
    assert isinstance(exportable, ExportableClassifier)
    assert (exportable.network.shape, exportable.patch_geometry.size) == (shape, 112)
    with torch.inference_mode():
        assert exportable.network(torch.zeros(1, 3, 112, 112)).shape == (1, 9)


@pytest.mark.parametrize("size", ["large", {"size": 20}, {"size": 112, "depth": 3}])
def test_an_invalid_recorded_size_is_an_error(saved: Any, foreign_weights: Weights, size: object) -> None:
    with pytest.raises(CheckpointError, match="does not record a valid network size"):
        read_network(saved({"network": foreign_weights, "record": {"config": {"network": size}}}))


def test_a_missing_record_is_reported(saved: Any, foreign_weights: Weights) -> None:
    assert read_network(saved({"network": foreign_weights, "step": 3}))[1]["data"] == "not recorded"


@pytest.mark.parametrize("wrap", ["", "model", "state_dict", "module."])
def test_a_foreign_network_needs_only_classes_and_patches(
    saved: Any, foreign_network: AlexNet, foreign_weights: Weights, wrap: str
) -> None:
    content: Any = foreign_weights
    if wrap == "module.":
        content = {f"module.{key}": value for key, value in foreign_weights.items()}
    elif wrap:
        content = {wrap: foreign_weights, "epoch": 3}
    exportable, _ = read_network(saved(content), FOREIGN)
    assert isinstance(exportable, ExportableClassifier)
    assert (exportable.normalization, exportable.patch_geometry.half_width) == ("imagenet", 0.4)
    x = torch.randn(1, 3, 224, 224, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        assert torch.equal(exportable.network(x), foreign_network(x))


def test_the_lane_becomes_the_second_class(saved: Any, foreign_weights: Weights) -> None:
    exportable, _ = read_network(saved(foreign_weights), ForeignNetwork(("lane", "road"), PatchGeometry(224)))
    assert isinstance(exportable, ExportableClassifier)
    assert exportable.classes == ("road", "lane")
    assert torch.equal(exportable.network.classifier[6].bias.data, foreign_weights["classifier.6.bias"].flip(0))


def test_networks_that_can_not_be_served_are_rejected(saved: Any, foreign_weights: Weights) -> None:
    short = {key: value for key, value in foreign_weights.items() if key != "features.3.bias"}
    wider = {**foreign_weights, "classifier.4.weight": torch.zeros(100, 4096)}
    corrupt = {**foreign_weights, "features.0.bias": torch.full((64,), torch.nan)}
    many = {**foreign_weights, "classifier.6.weight": torch.zeros(1000, 4096), "classifier.6.bias": torch.zeros(1000)}
    vgg = {**foreign_weights, "features.12.weight": torch.zeros(3)}
    invalid = (
        (short, "lacks features.3.bias"),
        (wider, "classifier.4.weight has the shape (100, 4096), expected (4096, 4096)"),
        (corrupt, "not finite"),
        (many, "has 1000 outputs, but the service needs 9, or 2 of a network from elsewhere"),
        (vgg, "has features.12.weight"),
        ({"conv1.weight": torch.zeros(3)}, "not an AlexNet"),
        ({"network": foreign_weights, "step": 1}, "remove --classes and --patch"),
    )
    for content, message in invalid:
        with pytest.raises(CheckpointError) as caught:
            read_network(saved(content), FOREIGN)
        assert message in str(caught.value)
    with pytest.raises(CheckpointError, match="--classes and --patch"):
        read_network(saved(foreign_weights))


@pytest.mark.parametrize(
    ("foreign", "message"),
    [
        (ForeignNetwork(("false", "true"), PatchGeometry(224)), "one of them lane"),
        (ForeignNetwork(("none", "lane", "curb"), PatchGeometry(224)), "can't be served"),
        (ForeignNetwork(("false", "lane"), PatchGeometry(size=100)), "takes size 224"),
    ],
)
def test_the_description_of_a_foreign_network_must_fit_the_service(
    saved: Any, foreign_weights: Weights, foreign: ForeignNetwork, message: str
) -> None:
    with pytest.raises(CheckpointError, match=message):
        read_network(saved(foreign_weights), foreign)
