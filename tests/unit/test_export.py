"""From AlexNet in PyTorch to the file that serves: folding, truncation, calibration, the file itself, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from numpy.typing import NDArray

from lanestream.errors import CheckpointError, ExportError, ModelError, ProviderError
from lanestream.inference import OnnxModel
from lanestream.inference.model_info import METADATA_KEY
from lanestream_exporter import export
from lanestream_exporter.alexnet import AlexNet, initialise, normalise
from lanestream_exporter.calibration import calibrated
from lanestream_exporter.compression import truncated
from lanestream_exporter.export import ExportSettings, export_classifier
from lanestream_exporter.patchstore import PatchStore, read_stores, write_store
from lanestream_exporter.training.checkpoints import read_checkpoint


@pytest.fixture(scope="module")
def patches() -> NDArray[np.uint8]:
    rng = np.random.default_rng(0)
    smooth = rng.integers(0, 256, (32, 14, 14, 3), dtype=np.uint8)
    return np.repeat(np.repeat(smooth, 16, axis=1), 16, axis=2)


@pytest.fixture(scope="module")
def network() -> AlexNet:
    """A network whose normalisation layers have something to fold."""
    torch.manual_seed(0)
    made = AlexNet()
    for norm in made.norms.values():
        assert isinstance(norm, torch.nn.BatchNorm2d)
        assert norm.running_mean is not None
        assert norm.running_var is not None
        torch.nn.init.uniform_(norm.weight, 0.5, 1.5)
        torch.nn.init.uniform_(norm.bias, -0.2, 0.2)
        torch.nn.init.uniform_(norm.running_mean, -0.2, 0.2)
        torch.nn.init.uniform_(norm.running_var, 0.5, 2.0)
    return made.eval()


@pytest.fixture(scope="module")
def store(patches: NDArray[np.uint8], tmp_path_factory: pytest.TempPathFactory) -> PatchStore:
    path = tmp_path_factory.mktemp("patches") / "all.npz"
    write_store(path, [(patch, i % 2) for i, patch in enumerate(patches)])
    return read_stores([path])


@pytest.fixture(scope="module")
def checkpoint(network: AlexNet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "best.pt"
    torch.save({"network": network.state_dict(), "step": 7}, path)
    return path


@torch.inference_mode()
def test_folding_keeps_the_function_and_leaves_the_plain_topology(network: AlexNet, patches: NDArray[np.uint8]) -> None:
    plain = network.folded()
    x = normalise(torch.from_numpy(patches[:4]))
    torch.testing.assert_close(plain(x), network(x), rtol=1e-3, atol=1e-4)
    assert not [key for key in plain.state_dict() if key.startswith("norms.")]


def test_the_plain_network_has_torchvisions_keys_and_shapes() -> None:
    shapes = {key: tuple(value.shape) for key, value in AlexNet(1000, normalised=False).state_dict().items()}
    assert shapes["features.0.weight"] == (64, 3, 11, 11)
    assert shapes["features.10.weight"] == (256, 256, 3, 3)
    assert shapes["classifier.1.weight"] == (4096, 9216)
    assert shapes["classifier.6.bias"] == (1000,)
    assert sum(int(np.prod(shape)) for shape in shapes.values()) == 61_100_840


@torch.inference_mode()
def test_truncation_is_small_and_nearly_exact_on_what_it_saw(network: AlexNet, patches: NDArray[np.uint8]) -> None:
    plain = network.folded()
    small = truncated(plain, 0.999, patches)
    weights = [sum(p.numel() for p in net.classifier.parameters()) for net in (plain, small)]
    assert weights[1] < 0.05 * weights[0]
    x = normalise(torch.from_numpy(patches))
    spread = plain(x).std().item()
    assert (small(x) - plain(x)).abs().max().item() < 0.3 * spread


@torch.inference_mode()
def test_brightness_and_contrast_of_a_patch_do_not_matter(patches: NDArray[np.uint8]) -> None:
    dim = (patches[:2].astype(np.float32) * 0.5 + 20.0).astype(np.uint8)
    difference = normalise(torch.from_numpy(dim)) - normalise(torch.from_numpy(patches[:2]))
    assert difference.abs().mean().item() < 0.1


def test_calibration_finds_the_temperature_that_made_the_labels() -> None:
    rng = np.random.default_rng(1)
    margin = rng.normal(0.0, 3.0, 20_000)
    labels = (rng.random(20_000) < 1.0 / (1.0 + np.exp(-margin))).astype(np.int64)
    logits = np.stack([np.zeros(20_000), 2.5 * margin], axis=1).astype(np.float32)
    found = calibrated(logits, labels)
    assert found.temperature == pytest.approx(2.5, rel=0.1)
    assert 0.3 < found.threshold < 0.6


@pytest.fixture(scope="module")
def exported(checkpoint: Path, store: PatchStore, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("models") / "small.onnx"
    report = export_classifier(checkpoint, path, ExportSettings(precision="fp32", rank_energy=0.999), store, store)
    assert report.path == path
    assert report.largest_difference < 1e-3
    return path


def test_the_file_serves_any_batch_alike(exported: Path, patches: NDArray[np.uint8]) -> None:
    model = OnnxModel.load(exported, "cpu")
    whole = model.run(patches)
    assert whole.shape == (32, 2)
    np.testing.assert_allclose(whole.sum(axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.concatenate([model.run(p[None]) for p in patches[:5]]), whole[:5], atol=1e-4)
    assert model.run(patches[:0]).shape == (0, 2)
    assert model.provider == "cpu"


def test_the_file_describes_itself_and_is_small(exported: Path) -> None:
    info = OnnxModel.load(exported, "cpu").info
    assert (info.kind, info.precision, info.strip.size) == ("classifier", "fp32", 224)
    assert info.training["step"] == 7
    assert info.metrics["validation_patches"] == 32
    assert exported.stat().st_size < 25e6


def test_a_file_that_differs_is_not_written(
    checkpoint: Path, store: PatchStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "_TOLERANCE", 0.0)
    monkeypatch.setattr(export, "_to_onnx", _other_network)
    out = tmp_path / "refused.onnx"
    with pytest.raises(ExportError, match="differs from PyTorch"):
        export_classifier(checkpoint, out, ExportSettings(precision="fp32", rank_energy=0.9), store, store)
    assert not out.exists()


def _other_network(_: export.ServedNetwork, path: Path) -> None:
    """Writes a file that answers every patch with certainty."""
    helper = onnx.helper
    shape = helper.make_node("Shape", ["patches"], ["shape"], start=0, end=1)
    two = helper.make_node("Constant", [], ["two"], value_ints=[2])
    both = helper.make_node("Concat", ["shape", "two"], ["size"], axis=0)
    ones = helper.make_node(
        "ConstantOfShape", ["size"], ["probabilities"], value=helper.make_tensor("v", 1, [1], [1.0])
    )
    graph = helper.make_graph(
        [shape, two, both, ones],
        "certain",
        [helper.make_tensor_value_info("patches", onnx.TensorProto.UINT8, ["N", 224, 224, 3])],
        [helper.make_tensor_value_info("probabilities", onnx.TensorProto.FLOAT, ["N", 2])],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), str(path))


def test_wrong_model_files_are_refused_in_one_line(exported: Path, tmp_path: Path) -> None:
    text = tmp_path / "text.onnx"
    text.write_text("no model")
    bare = tmp_path / "bare.onnx"
    model = onnx.load(str(exported))
    del model.metadata_props[:]
    onnx.save(model, str(bare))
    strange = tmp_path / "strange.onnx"
    onnx.helper.set_model_props(model, {METADATA_KEY: '{"kind": "segmenter"}'})
    onnx.save(model, str(strange))
    for path, words in (
        (tmp_path / "missing.onnx", "no model file"),
        (text, "not a model"),
        (bare, "does not describe itself"),
        (strange, "kind"),
    ):
        with pytest.raises(ModelError, match=words) as caught:
            OnnxModel.load(path, "cpu")
        assert "\n" not in str(caught.value)
        assert caught.value.hint


def test_cuda_is_not_replaced_in_silence(exported: Path) -> None:
    with pytest.raises(ProviderError, match="CUDA"):
        OnnxModel.load(exported, "cuda")
    auto = OnnxModel.load(exported, "auto")
    assert (auto.provider, auto.reason) == ("cpu", "the installed onnxruntime has no CUDA")


def test_wrong_checkpoints_are_refused(tmp_path: Path) -> None:
    text = tmp_path / "text.pt"
    text.write_text("no checkpoint")
    other = tmp_path / "other.pt"
    torch.save({"weights": torch.zeros(3)}, other)
    for path in (text, other, tmp_path / "missing.pt"):
        with pytest.raises(CheckpointError):
            read_checkpoint(path)
        with pytest.raises(CheckpointError):
            initialise(AlexNet(), path)


def test_torchvision_weights_are_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "alexnet.pt"
    theirs = AlexNet(1000, normalised=False)
    torch.save(theirs.state_dict(), path)
    mine = AlexNet()
    initialise(mine, path)
    assert torch.equal(mine.features[3].weight, theirs.features[3].weight)  # type: ignore[arg-type, union-attr]
    assert mine.classes == 2
