"""Which network a checkpoint holds: this trainer's own, torchvision's AlexNet from elsewhere, or none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from lanestream.detection.patches import PatchGeometry
from lanestream.errors import CheckpointError
from lanestream_exporter.alexnet import AlexNet, Shape, load_torchvision_weights
from lanestream_exporter.exporting.checkpoint import Foreign, read_subject
from lanestream_exporter.exporting.classifier import ClassifierSubject
from lanestream_exporter.training.run_files import read_checkpoint

Weights = dict[str, Tensor]

FOREIGN = Foreign(("false", "lane"), PatchGeometry(224, half_width=0.4))


@pytest.fixture(scope="module")
def theirs() -> Weights:
    """As torchvision's recipe saves it, fine-tuned to two classes."""
    torch.manual_seed(0)
    return AlexNet(batch_norm=False).state_dict()


@pytest.fixture
def saved(tmp_path: Path) -> Any:
    def save(content: object) -> Path:
        path = tmp_path / "given.pt"
        torch.save(content, path)
        return path

    return save


def test_wrong_checkpoints_are_refused(tmp_path: Path) -> None:
    text = tmp_path / "text.pt"
    text.write_text("no checkpoint")
    other = tmp_path / "other.pt"
    torch.save({"weights": torch.zeros(3)}, other)
    for path in (text, other, tmp_path / "missing.pt"):
        with pytest.raises(CheckpointError):
            read_checkpoint(path)
        with pytest.raises(CheckpointError):
            load_torchvision_weights(AlexNet(), path)
        for foreign in (None, FOREIGN):
            with pytest.raises(CheckpointError) as caught:
                read_subject(path, foreign)
            assert "\n" not in str(caught.value)
            assert caught.value.hint


def test_torchvision_weights_are_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "alexnet.pt"
    theirs = AlexNet(1000, batch_norm=False)
    torch.save(theirs.state_dict(), path)
    mine = AlexNet()
    load_torchvision_weights(mine, path)
    assert torch.equal(mine.features[3].weight, theirs.features[3].weight)  # type: ignore[arg-type, union-attr]
    assert mine.classes == 2


def test_what_the_trainer_recorded_goes_along(saved: Any) -> None:
    record = {"revision": "abc", "data": {"rendered": 3}, "config": {"seed": 1}, "torch": "2", "lanestream": "0"}
    state = {"network": AlexNet().state_dict(), "step": 7, "figures": {"validation": 0.25}, "record": record}
    subject, training = read_subject(saved(state))
    assert isinstance(subject, ClassifierSubject)
    assert subject.normalisation == "contrast"
    assert training == {**record, "step": 7, "figures": {"validation": 0.25}}


def test_a_network_is_as_large_as_its_run_made_it(saved: Any) -> None:
    shape = Shape(size=112, width=0.25, hidden=32)
    record = {"config": {"network": {"size": 112, "width": 0.25, "hidden": 32}}}
    subject, _ = read_subject(saved({"network": AlexNet(shape=shape).state_dict(), "record": record}))
    assert isinstance(subject, ClassifierSubject)
    assert (subject.network.shape, subject.strip.size) == (shape, 112)
    with torch.inference_mode():
        assert subject.network(torch.zeros(1, 3, 112, 112)).shape == (1, 2)


@pytest.mark.parametrize("told", ["large", {"size": 20}, {"size": 112, "depth": 3}])
def test_a_size_that_is_none_is_told_in_one_line(saved: Any, theirs: Weights, told: object) -> None:
    with pytest.raises(CheckpointError, match="does not say how large its network is"):
        read_subject(saved({"network": theirs, "record": {"config": {"network": told}}}))


def test_a_checkpoint_without_a_record_says_so(saved: Any, theirs: Weights) -> None:
    assert read_subject(saved({"network": theirs, "step": 3}))[1]["data"] == "not recorded"


@pytest.mark.parametrize("wrap", ["", "model", "state_dict", "module."])
def test_a_network_from_elsewhere_needs_only_classes_and_strips(saved: Any, theirs: Weights, wrap: str) -> None:
    content: Any = {f"module.{key}": value for key, value in theirs.items()} if wrap == "module." else theirs
    subject, _ = read_subject(
        saved({wrap: content, "epoch": 3} if wrap in ("model", "state_dict") else content), FOREIGN
    )
    assert isinstance(subject, ClassifierSubject)
    assert (subject.normalisation, subject.strip.half_width) == ("imagenet", 0.4)
    x = torch.randn(1, 3, 224, 224, generator=torch.Generator().manual_seed(1))
    network = AlexNet(batch_norm=False).eval()
    network.load_state_dict(theirs)
    with torch.inference_mode():
        assert torch.equal(subject.network(x), network(x))


def test_the_lane_is_the_second_class_wherever_it_was(saved: Any, theirs: Weights) -> None:
    subject, _ = read_subject(saved(theirs), Foreign(("lane", "road"), PatchGeometry(224)))
    assert isinstance(subject, ClassifierSubject)
    assert subject.classes == ("road", "lane")
    assert torch.equal(subject.network.classifier[6].bias.data, theirs["classifier.6.bias"].flip(0))


def test_networks_that_can_not_be_served_are_named(saved: Any, theirs: Weights) -> None:
    short = {key: value for key, value in theirs.items() if key != "features.3.bias"}
    wider = {**theirs, "classifier.4.weight": torch.zeros(100, 4096)}
    spoilt = {**theirs, "features.0.bias": torch.full((64,), torch.nan)}
    many = {**theirs, "classifier.6.weight": torch.zeros(1000, 4096), "classifier.6.bias": torch.zeros(1000)}
    vgg = {**theirs, "features.12.weight": torch.zeros(3)}
    wrong = (
        (short, "lacks features.3.bias"),
        (wider, "classifier.4.weight has the shape (100, 4096), not (4096, 4096)"),
        (spoilt, "no numbers"),
        (many, "tells 1000 classes apart"),
        (vgg, "has features.12.weight"),
        ({"conv1.weight": torch.zeros(3)}, "no AlexNet"),
        ({"network": theirs, "step": 1}, "leave --classes and --strip off"),
    )
    for content, words in wrong:
        with pytest.raises(CheckpointError) as caught:
            read_subject(saved(content), FOREIGN)
        assert words in str(caught.value)
    with pytest.raises(CheckpointError, match="--classes and --strip"):
        read_subject(saved(theirs))


@pytest.mark.parametrize(
    ("foreign", "words"),
    [
        (Foreign(("false", "true"), PatchGeometry(224)), "one of them lane"),
        (Foreign(("none", "lane", "curb"), PatchGeometry(224)), "can't be served"),
        (Foreign(("false", "lane"), PatchGeometry(size=100)), "takes 224"),
    ],
)
def test_what_is_said_of_a_network_must_fit_the_service(
    saved: Any, theirs: Weights, foreign: Foreign, words: str
) -> None:
    with pytest.raises(CheckpointError, match=words):
        read_subject(saved(theirs), foreign)
