"""Exporting a network from PyTorch to a file that can be served: outputs, metadata, refusals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from numpy.typing import NDArray

from lanestream.detection.ego_prior import UNKNOWN_HORIZONS
from lanestream.engine import load_engine
from lanestream.errors import ExportError, ModelError
from lanestream.inference.model_info import METADATA_KEY, ClassifierInfo, RegressorInfo
from lanestream.inference.onnx_model import load
from lanestream.road.appearance import MARKING_COLORS, MARKING_TYPES
from lanestream.road.crops import PatchGeometry
from lanestream_exporter.alexnet import AlexNet, ClassifierLogits, Shape, normalize
from lanestream_exporter.exporting import export
from lanestream_exporter.exporting.classifier import ExportableClassifier
from lanestream_exporter.exporting.compression import in_batches
from lanestream_exporter.exporting.export import ExportReport, ExportSettings, Provenance, export_network
from lanestream_exporter.exporting.exportable import (
    Calibration,
    ExportableNetwork,
    ExportDescription,
    Precision,
    ValidationSet,
)
from lanestream_exporter.exporting.frames import ExportFrames
from lanestream_exporter.exporting.graph import describe, write_graph
from lanestream_exporter.exporting.regressor import ExportableRegressor
from lanestream_exporter.regressor import LaneRegressor, RegressorPrediction

SOURCE = ExportFrames(None, rendered=4)
PROVENANCE = Provenance({"data": "none", "step": 7}, SOURCE)


def settings(precision: Precision) -> ExportSettings:
    """Returns settings with no limit on accuracy, which is random for an untrained network."""
    return ExportSettings("tiny", "1", 0.9, precision, tolerance=100.0)


@dataclass(frozen=True)
class Exported:
    """A written file, its report, and the validation set that it was verified on."""

    path: Path
    report: ExportReport
    validation: ValidationSet


def exported(exportable: ExportableNetwork, precision: Precision, folder: Path) -> Exported:
    path = folder / f"{precision}.onnx"
    steps: list[str] = []
    report = export_network(exportable, path, settings(precision), PROVENANCE, steps.append)
    assert "rendered" in steps[0]
    return Exported(path, report, report.network.validation_set(SOURCE))


@pytest.fixture(scope="module")
def classifier(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    torch.manual_seed(0)
    network = AlexNet(shape=Shape(112, 0.5, 512), batch_norm=False).eval()
    exportable = ExportableClassifier(network, patch_geometry=PatchGeometry(112))
    # A fresh AlexNet gives nearly the same output for every patch, so its small differences are amplified.
    logits = in_batches(lambda part: network(normalize(part)), exportable.training_inputs(SOURCE))
    last = network.classifier[6]
    assert isinstance(last, torch.nn.Linear)
    with torch.no_grad():
        last.weight /= logits.std(dim=0)[:, None]
        last.bias.copy_((last.bias - logits.mean(dim=0)) / logits.std(dim=0))
    return exported(exportable, "int8", tmp_path_factory.mktemp("classifier"))


@pytest.fixture(scope="module")
def regressor(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    torch.manual_seed(0)
    network = LaneRegressor(Shape(160, 0.5, 256)).eval().folded()
    return exported(ExportableRegressor(network), "fp32", tmp_path_factory.mktemp("regressor"))


def test_the_classifier_file_matches_pytorch_at_any_batch_size(classifier: Exported) -> None:
    model = load(classifier.path)
    inputs = classifier.validation.inputs[:20]
    expected = in_batches(classifier.report.network.serving_module(), inputs).numpy()
    assert expected[:, 1].std() > 0.02
    outputs = model.run(inputs)
    for part in np.split(outputs, [3, 7], axis=1):
        np.testing.assert_allclose(part.sum(axis=1), 1.0, atol=1e-5)
    assert np.abs(outputs - expected).mean() < 0.3 * expected[:, 1].std()
    np.testing.assert_allclose(np.concatenate([model.run(p[None]) for p in inputs[:5]]), outputs[:5], atol=1e-4)
    assert model.run(inputs[:0]).shape == (0, 9)


def test_int8_is_compared_with_fp32_and_much_smaller(classifier: Exported) -> None:
    report = classifier.report
    assert (report.fp32.name, report.written.name) == ("fp32", "int8")
    assert report.fp32.largest_difference < 1e-3 < report.written.largest_difference
    assert report.written.size == pytest.approx(0.25 * (report.fp32.size or 0), rel=0.2)
    assert set(report.lost) == {"checkpoint", "fp32"}
    assert report.time_ratio is not None
    assert report.inputs == len(classifier.validation.inputs)


def test_int8_weights_use_seven_bits(classifier: Exported) -> None:
    """Processors that add two products in sixteen bits would saturate with larger weights."""
    parameters = onnx.load(str(classifier.path)).graph.initializer
    weights = [onnx.numpy_helper.to_array(part) for part in parameters if part.name.endswith("weight_quantized")]
    assert len(weights) > 7
    assert {int(np.abs(part.astype(int)).max()) for part in weights} == {64}


def test_the_regressor_file_matches_pytorch(regressor: Exported) -> None:
    exportable = regressor.report.network
    assert isinstance(exportable, ExportableRegressor)
    inputs = regressor.validation.inputs
    with torch.inference_mode():
        answer = RegressorPrediction.of(exportable.network(normalize(torch.from_numpy(inputs))))
    expected = replace(answer, presence=answer.presence / exportable.calibration.temperature).served().numpy()
    np.testing.assert_allclose(load(regressor.path).run(inputs), expected, atol=1e-4)
    assert regressor.report.written is regressor.report.fp32
    assert regressor.report.time_ratio is None


def test_the_regressors_metrics_use_what_its_detector_reads(regressor: Exported) -> None:
    validation, exportable = regressor.validation, regressor.report.network
    assert isinstance(exportable, ExportableRegressor)
    assert len(validation.images) == len(validation.contexts) == 2 * validation.frames
    assert {len(values) for values in validation.truth.values()} == {len(validation.images)}
    # An unknown horizon takes a crop for each row that is tried, and one more.
    assert len(validation.inputs) >= (2 + len(UNKNOWN_HORIZONS)) * validation.frames
    run = load(regressor.path).run
    good = replace(validation, truth={**validation.truth, "columns": exportable._read(run, validation)[0]})
    metrics = exportable.metrics(run, good)
    assert metrics["accuracy"] == 1.0
    assert metrics["error_near_px"] == metrics["error_far_px"] == 0.0
    off = replace(good, truth={**good.truth, "columns": good.truth["columns"] + 0.01})
    metrics = exportable.metrics(run, off)
    assert metrics["accuracy"] == 0.0
    assert metrics["error_near_px"] == pytest.approx(6.4)


def test_the_regressors_small_layers_stay_in_fp32_in_an_int8_file(regressor: Exported, tmp_path: Path) -> None:
    exportable = regressor.report.network
    small = tmp_path / "int8.onnx"
    export.quantize(regressor.path, small, regressor.validation.inputs, exportable.fp32_layers)
    weights = {tensor.name: tensor.data_type for tensor in onnx.load(str(small)).graph.initializer}
    floats = [name for name, kind in weights.items() if kind == onnx.TensorProto.FLOAT and name.endswith("weight")]
    assert {name.split(".")[1] for name in floats} == {"features", "hidden", "column_head", "auxiliary_head"}
    assert [name for name in floats if ".features." in name] == ["network.features.0.weight"]
    info = load(regressor.path).info
    describe(small, info)
    expected = in_batches(exportable.serving_module(), regressor.validation.inputs).numpy()
    assert np.abs(load(small).run(regressor.validation.inputs) - expected).mean() < 0.01


def test_both_files_run_in_their_detectors(classifier: Exported, regressor: Exported) -> None:
    for made in (classifier, regressor):
        engine = load_engine(made.path, "cpu", regressor=None)
        detector = engine.detectors[engine.select()]
        image, run = made.validation.images[0], engine.main_model().run
        found = detector.detect(image, made.validation.contexts[0], made.report.network.infer(run))
        assert (found.view.width, found.view.height) == (image.shape[1], image.shape[0])
        assert type(detector) is type(made.report.network.detector)


def test_the_files_describe_themselves(classifier: Exported, regressor: Exported) -> None:
    info = load(classifier.path).info
    assert isinstance(info, ClassifierInfo)
    assert (info.precision, info.classes, info.patch.size) == ("int8", ("nothing", "marking", "road_edge"), 112)
    assert (info.types, info.colors) == (MARKING_TYPES, MARKING_COLORS)
    calibration = classifier.report.network.calibration
    temperatures = info.temperature, info.type_temperature, info.color_temperature
    assert temperatures == (calibration.temperature, calibration.type_temperature, calibration.color_temperature)
    assert len({1.0, *temperatures}) == 4
    assert info.training == {
        "data": "none", "step": 7, "rank_energy": 0.9, "export_frames": "rendered scenes", "normalization": "contrast",
    }  # fmt: skip
    assert info.metrics["frame_count"] == 4
    for name in ("accuracy", "average_precision", "type_accuracy", "color_accuracy"):
        assert info.metrics[name] == pytest.approx(classifier.report.written.metrics[name], abs=1e-4)
        assert 0.0 <= info.metrics[name] <= 1.0
    assert info.threshold == classifier.report.network.calibration.threshold
    other = load(regressor.path).info
    assert isinstance(other, RegressorInfo)
    assert (other.road_crop.size, other.road_crop.detail_width, other.precision) == (160, 448, "fp32")
    assert (other.kinds, other.outputs) == (("marking", "road_edge"), 17)
    assert 0.0 <= other.metrics["kind_accuracy"] <= 1.0
    assert "onnxruntime" in other.exporter


def test_half_precision_loads_on_the_cpu_and_agrees(classifier: Exported, tmp_path: Path) -> None:
    exportable = classifier.report.network
    path = tmp_path / "fp16.onnx"
    names = exportable.input_name, exportable.output_name
    write_graph(exportable.serving_module(half=True), classifier.validation.inputs, path, names)
    describe(path, exportable.info(ExportDescription("half", "1", "fp16", {}, {})))
    graph = onnx.load(str(path)).graph
    weights = [tensor for tensor in graph.initializer if tensor.name.endswith("weight")]
    assert {tensor.data_type for tensor in weights} == {onnx.TensorProto.FLOAT16}
    assert graph.input[0].type.tensor_type.elem_type == onnx.TensorProto.UINT8
    assert graph.output[0].type.tensor_type.elem_type == onnx.TensorProto.FLOAT
    inputs = classifier.validation.inputs[:8]
    expected = in_batches(exportable.serving_module(), inputs).numpy()
    np.testing.assert_allclose(load(path).run(inputs), expected, atol=0.02)


def test_a_file_that_differs_is_not_written(
    classifier: Exported, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "write_graph", _other_network)
    out = tmp_path / "refused.onnx"
    with pytest.raises(ExportError, match=r"differs from PyTorch by 0\.\d+ on average"):
        export_network(classifier.report.network, out, settings("fp32"), PROVENANCE, lambda _: None)
    assert not list(tmp_path.iterdir())


def _other_network(_: Any, example: NDArray[np.uint8], path: Path, names: tuple[str, str]) -> None:
    """Writes a file whose outputs are certain for every patch."""
    helper = onnx.helper
    input_name, output_name = names
    shape = helper.make_node("Shape", [input_name], ["shape"], start=0, end=1)
    nine = helper.make_node("Constant", [], ["nine"], value_ints=[9])
    both = helper.make_node("Concat", ["shape", "nine"], ["size"], axis=0)
    ones = helper.make_node("ConstantOfShape", ["size"], [output_name], value=helper.make_tensor("v", 1, [1], [1.0]))
    graph = helper.make_graph(
        [shape, nine, both, ones],
        "certain",
        [helper.make_tensor_value_info(input_name, onnx.TensorProto.UINT8, ["N", *example.shape[1:]])],
        [helper.make_tensor_value_info(output_name, onnx.TensorProto.FLOAT, ["N", 9])],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), str(path))


@pytest.mark.parametrize(
    ("lost", "message"),
    [
        ({"accuracy": 0.906}, "loses 0.60 points of accuracy against fp32; 0.5 are allowed"),
        ({"accuracy": float("nan")}, "loses nan points"),
    ],
)
def test_accuracy_beyond_the_tolerance_is_refused(classifier: Exported, lost: dict[str, float], message: str) -> None:
    report = classifier.report
    good = {"accuracy": 0.912, "average_precision": 0.9}
    fp32, checkpoint = replace(report.fp32, metrics=good), replace(report.checkpoint, metrics={"accuracy": 0.911})
    passing = replace(report, checkpoint=checkpoint, fp32=fp32, written=replace(report.written, metrics=good))
    limits = ExportSettings("x", "1", 0.9, "int8")
    export._check_tolerance(passing, limits)
    with pytest.raises(ExportError) as caught:
        export._check_tolerance(replace(passing, written=replace(report.written, metrics=lost)), limits)
    assert message in str(caught.value) or "checkpoint" in str(caught.value)
    assert "--rank-energy closer to 1 or --precision fp16 or fp32" in caught.value.hint


def test_a_network_of_two_classes_from_elsewhere_is_exported(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = AlexNet(2, Shape(112, 0.2, 64), batch_norm=False).eval()
    exportable = ExportableClassifier(network, ("false", "lane"), PatchGeometry(112), "imagenet")
    made = exported(exportable, "fp32", tmp_path)
    model, inputs = load(made.path), made.validation.inputs[:5]
    expected = in_batches(made.report.network.serving_module(), inputs).numpy()
    np.testing.assert_allclose(model.run(inputs), expected, atol=1e-4)
    assert expected.shape == (5, 2)
    assert isinstance(model.info, ClassifierInfo)
    assert (model.info.classes, model.info.types, model.info.colors) == (("false", "lane"), (), ())
    assert {"accuracy", "average_precision", "frame_count"} == set(model.info.metrics) & {
        "accuracy",
        "average_precision",
        "frame_count",
        "type_accuracy",
        "color_accuracy",
    }


def test_a_foreign_network_keeps_its_own_normalization(classifier: Exported) -> None:
    exportable = classifier.report.network
    assert isinstance(exportable, ExportableClassifier)
    inputs = classifier.validation.inputs[:4]
    foreign = replace(exportable, normalization="imagenet").with_calibration(Calibration())
    means, sigmas = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    pixels = (inputs / 255.0 - np.array(means)) / np.array(sigmas)
    with torch.inference_mode():
        x = torch.from_numpy(pixels.astype(np.float32)).permute(0, 3, 1, 2)
        logits = ClassifierLogits.of(foreign.network(x))
        expected = np.hstack([torch.softmax(each, dim=1) for each in (logits.kinds, logits.types, logits.colors)])
    np.testing.assert_allclose(in_batches(foreign.serving_module(), inputs).numpy(), expected, atol=1e-4)
    assert foreign.info(ExportDescription("foreign", "1", "fp32", {}, {})).training == {"normalization": "imagenet"}


def test_invalid_model_files_are_rejected_in_one_line(classifier: Exported, tmp_path: Path) -> None:
    text = tmp_path / "text.onnx"
    text.write_text("not a model")
    bare = tmp_path / "bare.onnx"
    model = onnx.load(str(classifier.path))
    del model.metadata_props[:]
    onnx.save(model, str(bare))
    strange = tmp_path / "strange.onnx"
    onnx.helper.set_model_props(model, {METADATA_KEY: '{"kind": "segmenter"}'})
    onnx.save(model, str(strange))
    for path, message in (
        (tmp_path / "missing.onnx", "no model file"),
        (text, "not a model"),
        (bare, "does not describe itself"),
        (strange, "kind"),
    ):
        with pytest.raises(ModelError, match=message) as caught:
            load(path)
        assert "\n" not in str(caught.value)
        assert caught.value.hint


def test_a_file_contains_no_paths_of_the_machine_it_was_made_on(regressor: Exported) -> None:
    assert str(Path(torch.__file__).parents[1]).encode() not in regressor.path.read_bytes()
