"""The parts of an export: folding, truncation, calibration, normalization, comparing boundaries, publishing files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from lanestream.detection.ego_prior import RoadRegressor
from lanestream.detection.interface import FrameContext, Infer, ModelRole
from lanestream.detection.regression_detector import RegressionDetector
from lanestream.errors import ExportError
from lanestream.road.crops import PatchGeometry
from lanestream.road.curve import Curve
from lanestream.road.results import Detection
from lanestream_exporter.alexnet import AlexNet, ClassifierLogits, Shape, normalize
from lanestream_exporter.exporting import proof
from lanestream_exporter.exporting.classifier import ExportableClassifier
from lanestream_exporter.exporting.compression import truncate_layers
from lanestream_exporter.exporting.exportable import Calibration, ValidationSet, fit_calibration, fit_temperature
from lanestream_exporter.exporting.graph import contrast, imagenet, publish
from lanestream_exporter.exporting.proof import compare_boundaries
from lanestream_exporter.samples.truth import MARKING, NOTHING, ROAD_EDGE, UNKNOWN, UNSURE


@pytest.fixture(scope="module")
def patches() -> NDArray[np.uint8]:
    rng = np.random.default_rng(0)
    smooth = rng.integers(0, 256, (32, 14, 14, 3), dtype=np.uint8)
    return np.repeat(np.repeat(smooth, 16, axis=1), 16, axis=2)


@pytest.fixture(scope="module")
def network() -> AlexNet:
    """Returns a network with nontrivial batch normalization layers."""
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


@torch.inference_mode()
def test_folding_keeps_the_function_and_removes_the_normalization(network: AlexNet, patches: NDArray[np.uint8]) -> None:
    plain = network.folded()
    x = normalize(torch.from_numpy(patches[:4]))
    torch.testing.assert_close(plain(x), network(x), rtol=1e-3, atol=1e-4)
    assert not [key for key in plain.state_dict() if key.startswith("norms.")]


def test_the_plain_network_has_torchvisions_keys_and_shapes() -> None:
    shapes = {key: tuple(value.shape) for key, value in AlexNet(1000, batch_norm=False).state_dict().items()}
    assert shapes["features.0.weight"] == (64, 3, 11, 11)
    assert shapes["features.10.weight"] == (256, 256, 3, 3)
    assert shapes["classifier.1.weight"] == (4096, 9216)
    assert shapes["classifier.6.bias"] == (1000,)
    assert sum(int(np.prod(shape)) for shape in shapes.values()) == 61_100_840


@pytest.fixture(scope="module")
def layers() -> nn.Sequential:
    torch.manual_seed(1)
    return nn.Sequential(nn.Linear(300, 200), nn.ReLU(), nn.Linear(200, 200), nn.ReLU(), nn.Linear(200, 2)).eval()


@torch.inference_mode()
def test_truncation_is_small_and_nearly_exact_on_its_training_inputs(layers: nn.Sequential) -> None:
    few = torch.randn(5, 300, generator=torch.Generator().manual_seed(2))
    x = torch.randn(64, 5, generator=torch.Generator().manual_seed(3)) @ few  # low-dimensional, as roads are
    small = truncate_layers(layers, x, 0.9999)
    weights = [sum(p.numel() for p in net.parameters()) for net in (layers, small)]
    assert weights[1] < 0.5 * weights[0]
    assert (small(x) - layers(x)).abs().max().item() < 0.05 * layers(x).std().item()


@torch.inference_mode()
def test_components_between_thin_layers_have_similar_magnitudes(layers: nn.Sequential) -> None:
    directions = torch.linalg.qr(torch.randn(300, 8, generator=torch.Generator().manual_seed(5))).Q
    sizes = torch.tensor([64.0, 8.0, 4.0, 2.0, 1.0, 0.5, 0.25, 0.1])
    x = (torch.randn(256, 8, generator=torch.Generator().manual_seed(6)) * sizes) @ directions.T
    thin = truncate_layers(layers, x, 0.9999)[0]
    assert isinstance(thin, nn.Sequential)
    spread = thin[0](x).std(dim=0)
    assert len(spread) > 2
    assert spread.max() < 12.0 * spread.min()  # the components themselves: more than 60


@torch.inference_mode()
def test_truncation_keeps_layers_that_it_would_not_shrink(layers: nn.Sequential) -> None:
    x = torch.randn(400, 300, generator=torch.Generator().manual_seed(4))
    for energy in (1.0, 0.999999):
        assert torch.equal(truncate_layers(layers, x, energy)(x), layers(x))


@torch.inference_mode()
def test_brightness_and_contrast_of_a_patch_are_normalized_away(patches: NDArray[np.uint8]) -> None:
    dim = (patches[:2].astype(np.float32) * 0.5 + 20.0).astype(np.uint8)
    difference = normalize(torch.from_numpy(dim)) - normalize(torch.from_numpy(patches[:2]))
    assert difference.abs().mean().item() < 0.1


def test_the_served_normalization_matches_training(patches: NDArray[np.uint8]) -> None:
    images = torch.from_numpy(np.concatenate([patches[:6], patches[:2] // 50, np.full_like(patches[:1], 77)]))
    torch.testing.assert_close(contrast(images), normalize(images), rtol=1e-4, atol=1e-5)


def test_the_imagenet_normalization_matches_torchvision() -> None:
    red = np.zeros((1, 2, 2, 3), np.uint8)
    red[..., 0] = 255
    made = imagenet(torch.from_numpy(red))
    expected = torch.tensor([(1.0 - 0.485) / 0.229, -0.456 / 0.224, -0.406 / 0.225])
    torch.testing.assert_close(made[0, :, 1, 1], expected)
    assert made.shape == (1, 3, 2, 2)


def test_calibration_finds_the_temperature_that_made_the_labels() -> None:
    rng = np.random.default_rng(1)
    margin = rng.normal(0.0, 3.0, 20_000)
    labels = (rng.random(20_000) < 1.0 / (1.0 + np.exp(-margin))).astype(np.int64)
    logits = np.stack([np.zeros(20_000), 2.5 * margin], axis=1).astype(np.float32)
    found = fit_calibration(logits, labels)
    assert found.temperature == pytest.approx(2.5, rel=0.1)
    assert 0.3 < found.threshold < 0.6


def test_the_threshold_of_three_classes_is_for_all_but_the_first() -> None:
    rng = np.random.default_rng(2)
    logits = rng.normal(0.0, 2.0, (20_000, 3))
    probabilities = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    labels = (rng.random((20_000, 1)) > probabilities.cumsum(axis=1)).sum(axis=1)
    found = fit_calibration((1.7 * logits).astype(np.float32), labels)
    assert found.temperature == pytest.approx(1.7, rel=0.05)
    accepted = 1.0 - probabilities[:, 0] >= found.threshold
    assert (accepted == (labels > 0)).mean() > 0.8
    assert found.temperature == pytest.approx(fit_temperature((1.7 * logits).astype(np.float32), labels))


# What patches may show, and their types and colors.
TARGETS = (
    (NOTHING, -1, -1),
    (MARKING, 1, 0),
    (ROAD_EDGE, -1, -1),
    (MARKING | ROAD_EDGE, -1, 1),
    (NOTHING | ROAD_EDGE, -1, -1),
    (UNSURE, -1, -1),
    (UNKNOWN, -1, -1),
)


def validation_of(targets: Sequence[tuple[int, int, int]]) -> ValidationSet:
    return ValidationSet(1, (), (), np.zeros((len(targets), 64, 64, 3), np.uint8), {"targets": np.array(targets)})


def metrics_of(targets: Sequence[tuple[int, int, int]], *outputs: Sequence[float]) -> dict[str, float]:
    """Returns the metrics of a network with these outputs for patches with these targets."""
    network = ExportableClassifier(AlexNet(shape=Shape(64, 0.1, 8), batch_norm=False), patch_geometry=PatchGeometry(64))
    return network.metrics(lambda _: np.array(outputs, np.float32), validation_of(targets))


def test_the_metrics_of_a_classifier_count_clear_candidates_and_known_types_and_colors() -> None:
    nothing, marking, edge = (0.9, 0.1, 0.0), (0.1, 0.8, 0.1), (0.0, 0.1, 0.9)
    dashed, solid, white = (0.1, 0.7, 0.1, 0.1), (0.7, 0.1, 0.1, 0.1), (0.9, 0.1)
    kinds = (nothing, marking, edge, marking, marking, marking, marking)
    right = metrics_of(TARGETS, *((*kind, *dashed, *white) for kind in kinds))
    assert right["accuracy"] == right["average_precision"] == right["type_accuracy"] == 1.0
    assert right["color_accuracy"] == 0.5  # of the two candidates with a known color one is yellow
    confused = metrics_of(TARGETS, *((*kind, *solid, *white) for kind in (nothing, edge, edge, edge, *kinds[4:])))
    assert confused["accuracy"] == 0.75
    assert confused["type_accuracy"] == 0.0
    missed = metrics_of(TARGETS, *((*kind, *dashed, *white) for kind in (edge, nothing, nothing, nothing, *kinds[4:])))
    assert missed["accuracy"] == 0.0
    unknown = metrics_of(TARGETS[:1], (*nothing, *dashed, *white))
    assert unknown["accuracy"] == 1.0
    assert np.isnan(unknown["average_precision"])
    assert "type_accuracy" not in unknown


def test_kinds_types_and_colors_are_calibrated_each_by_itself() -> None:
    rng = np.random.default_rng(3)
    targets = [(kind, int(rng.integers(4)), int(rng.integers(2))) for kind in (NOTHING, MARKING, ROAD_EDGE) * 40]
    shape = Shape(64, 0.1, 8)
    torch.manual_seed(0)
    network = ExportableClassifier(AlexNet(shape=shape, batch_norm=False).eval(), patch_geometry=PatchGeometry(64))
    validation = validation_of(targets)
    validation.inputs[:] = rng.integers(0, 256, validation.inputs.shape)
    with torch.inference_mode():
        logits = ClassifierLogits.of(network.network(contrast(torch.from_numpy(validation.inputs))))
    kinds = np.array([(NOTHING, MARKING, ROAD_EDGE).index(kind) for kind, *_ in targets])
    found = network.calibrated(validation).calibration
    expected = [
        fit_temperature(values.numpy(), labels)
        for values, labels in zip(
            (logits.kinds, logits.types, logits.colors), (kinds, *np.array(targets).T[1:]), strict=True
        )
    ]
    temperatures = [found.temperature, found.type_temperature, found.color_temperature]
    assert temperatures == pytest.approx(expected, rel=1e-3)


def test_equal_labels_give_the_default_calibration() -> None:
    assert fit_calibration(np.ones((9, 2), np.float32), np.ones(9, np.int64)) == Calibration(1.0, 0.5)


def test_boundaries_of_two_networks_are_compared_by_columns() -> None:
    image, inputs = np.zeros((360, 640, 3), np.uint8), np.zeros((2, 224, 224, 3), np.uint8)
    validation = ValidationSet(2, (image, image), (FrameContext(160.0),) * 2, inputs, {})
    detector = RegressionDetector(RoadRegressor(0.5))
    straight = [-0.3, -0.12, -0.05, 0.3, 0.12, 0.05, *[0.01] * 6, 0.9, 0.9, 0.0]
    both = np.array([straight], np.float32)
    single = both.copy()
    single[0, 13] = 0.0
    found = compare_boundaries(detector, validation, returning(both, both), returning(both, single))
    assert (found.matched, found.unmatched) == (3, 1)
    assert 0.0 < found.mean < found.largest  # a boundary fitted alone differs from one fitted jointly
    equal = compare_boundaries(detector, validation, returning(both, both), returning(both, both))
    assert (equal.matched, equal.unmatched, equal.mean, equal.largest) == (4, 0, 0.0, 0.0)


def returning(*outputs: NDArray[np.float32]) -> Infer:
    """Returns a network with these outputs, call by call."""
    remaining = iter(outputs)

    def infer(role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        assert role == "regressor"
        return next(remaining)[: len(inputs)]

    return infer


def test_only_close_boundaries_are_matched() -> None:
    def shifted(by: float) -> list[Detection]:
        return [Detection(Curve(100.0, (320.0 + by, b, 0.0)), np.eye(3), 200.0, 350.0, 0.9) for b in (-1.0, 1.0)]

    pairs = proof._match(shifted(0.0), shifted(1.5), scale=0.5)
    assert [gap.max() for gap in pairs] == pytest.approx([0.75, 0.75])
    assert not proof._match(shifted(0.0), shifted(40.0), scale=0.5)


def test_a_failed_publish_raises_and_leaves_no_partial_file(tmp_path: Path) -> None:
    made = tmp_path / "made.onnx"
    made.write_bytes(b"model")
    (tmp_path / "taken").mkdir()
    with pytest.raises(ExportError, match="can't write"):
        publish(made, tmp_path / "taken")
    with pytest.raises(ExportError, match="can't write"):
        publish(made, made / "below" / "out.onnx")
    publish(made, tmp_path / "new" / "out.onnx")
    assert (tmp_path / "new" / "out.onnx").read_bytes() == b"model"
    assert not list(tmp_path.rglob("*.part"))
