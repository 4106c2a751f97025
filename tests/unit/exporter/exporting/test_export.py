"""From a network in PyTorch to the file that serves: its answers, what it says of itself, refusals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from numpy.typing import NDArray

from lanestream.detection.patches import PatchGeometry
from lanestream.engine import load_engine
from lanestream.errors import ExportError, ModelError
from lanestream.inference import ClassifierInfo, OnnxModel, RegressorInfo
from lanestream.inference.model_info import METADATA_KEY
from lanestream_exporter.alexnet import AlexNet, Shape, normalize
from lanestream_exporter.exporting import export
from lanestream_exporter.exporting.calibration import Calibration
from lanestream_exporter.exporting.classifier import ClassifierSubject
from lanestream_exporter.exporting.compression import in_batches
from lanestream_exporter.exporting.export import ExportReport, ExportSettings, Provenance, export_network
from lanestream_exporter.exporting.frames import FrameSource
from lanestream_exporter.exporting.graph import describe, write_graph
from lanestream_exporter.exporting.regressor import RegressorSubject
from lanestream_exporter.exporting.subject import Check, Description, Precision, Subject
from lanestream_exporter.regressor import LaneRegressor, RegressorPrediction

SOURCE = FrameSource(None, rendered=4)
PROVENANCE = Provenance({"data": "none", "step": 7}, SOURCE)


def settings(precision: Precision) -> ExportSettings:
    """An untrained network's accuracy is luck: no tolerance for it."""
    return ExportSettings("tiny", 0.9, precision, tolerance=100.0)


@dataclass(frozen=True)
class Exported:
    """A written file, what it measured, and the frames that it was proved on."""

    path: Path
    report: ExportReport
    check: Check


def exported(subject: Subject, precision: Precision, folder: Path) -> Exported:
    path = folder / f"{precision}.onnx"
    steps: list[str] = []
    report = export_network(subject, path, settings(precision), PROVENANCE, steps.append)
    assert "rendered" in steps[0]
    return Exported(path, report, report.subject.check(SOURCE))


@pytest.fixture(scope="module")
def classifier(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    torch.manual_seed(0)
    network = AlexNet(shape=Shape(112, 0.5, 512), batch_norm=False).eval()
    subject = ClassifierSubject(network, strip=PatchGeometry(112))
    # A fresh AlexNet answers every patch alike: its small differences are made large, about their mean.
    logits = in_batches(lambda part: network(normalize(part)), subject.ranging(SOURCE))
    last = network.classifier[6]
    assert isinstance(last, torch.nn.Linear)
    with torch.no_grad():
        last.weight /= logits.std(dim=0)[:, None]
        last.bias.copy_((last.bias - logits.mean(dim=0)) / logits.std(dim=0))
    return exported(subject, "int8", tmp_path_factory.mktemp("classifier"))


@pytest.fixture(scope="module")
def regressor(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    torch.manual_seed(0)
    network = LaneRegressor(Shape(160, 0.5, 256)).eval().folded()
    return exported(RegressorSubject(network), "fp32", tmp_path_factory.mktemp("regressor"))


def test_the_classifiers_file_answers_as_pytorch_does_at_any_batch_size(classifier: Exported) -> None:
    model = OnnxModel.load(classifier.path, "cpu")
    inputs = classifier.check.inputs[:20]
    expected = in_batches(classifier.report.subject.served(), inputs).numpy()
    assert expected[:, 1].std() > 0.02
    whole = model.run(inputs)
    np.testing.assert_allclose(whole.sum(axis=1), 1.0, atol=1e-5)
    assert np.abs(whole - expected).mean() < 0.3 * expected[:, 1].std()
    np.testing.assert_allclose(np.concatenate([model.run(p[None]) for p in inputs[:5]]), whole[:5], atol=1e-4)
    assert model.run(inputs[:0]).shape == (0, 2)


def test_int8_is_measured_against_fp32_and_much_smaller(classifier: Exported) -> None:
    report = classifier.report
    assert (report.fp32.name, report.written.name) == ("fp32", "int8")
    assert report.fp32.largest_difference < 1e-3 < report.written.largest_difference
    assert report.written.size == pytest.approx(0.25 * (report.fp32.size or 0), rel=0.2)
    assert set(report.lost) == {"checkpoint", "fp32"}
    assert report.time_ratio is not None
    assert report.inputs == len(classifier.check.inputs)


def test_int8_weights_take_seven_bits(classifier: Exported) -> None:
    """Processors that add two products in sixteen bits would cut off sums of larger ones."""
    parameters = onnx.load(str(classifier.path)).graph.initializer
    weights = [onnx.numpy_helper.to_array(part) for part in parameters if part.name.endswith("weight_quantized")]
    assert len(weights) > 7
    assert {int(np.abs(part.astype(int)).max()) for part in weights} == {64}


def test_the_regressors_file_says_what_its_answer_is(regressor: Exported) -> None:
    subject = regressor.report.subject
    assert isinstance(subject, RegressorSubject)
    inputs = regressor.check.inputs
    with torch.inference_mode():
        answer = RegressorPrediction.of(subject.network(normalize(torch.from_numpy(inputs))))
    told = replace(answer, presence=answer.presence / subject.calibration.temperature).served().numpy()
    np.testing.assert_allclose(OnnxModel.load(regressor.path, "cpu").run(inputs), told, atol=1e-4)
    assert regressor.report.written is regressor.report.fp32
    assert regressor.report.time_ratio is None


def test_the_regressor_is_judged_by_what_its_detector_reads(regressor: Exported) -> None:
    check, subject = regressor.check, regressor.report.subject
    assert {len(values) for values in check.truth.values()} == {len(check.prepared)} == {2 * check.frames}
    good = replace(check, truth={**check.truth, "columns": subject._read(_outputs(regressor), check)[0]})  # type: ignore[attr-defined]
    figures = subject.figures(_outputs(regressor), good)
    assert figures["accuracy"] == 1.0
    assert figures["error_near_px"] == figures["error_far_px"] == 0.0
    off = replace(good, truth={**good.truth, "columns": good.truth["columns"] + 0.01})
    figures = subject.figures(_outputs(regressor), off)
    assert figures["accuracy"] == 0.0
    assert figures["error_near_px"] == pytest.approx(6.4)


def _outputs(made: Exported) -> NDArray[np.float32]:
    return OnnxModel.load(made.path, "cpu").run(made.check.inputs)


def test_the_regressors_small_layers_stay_exact_in_int8(regressor: Exported, tmp_path: Path) -> None:
    subject = regressor.report.subject
    small = tmp_path / "int8.onnx"
    export.quantized(regressor.path, small, regressor.check.inputs, subject.exact)
    weights = {tensor.name: tensor.data_type for tensor in onnx.load(str(small)).graph.initializer}
    floats = [name for name, kind in weights.items() if kind == onnx.TensorProto.FLOAT and name.endswith("weight")]
    assert {name.split(".")[1] for name in floats} == {"features", "hidden", "column_head", "auxiliary_head"}
    assert [name for name in floats if ".features." in name] == ["network.features.0.weight"]
    info = OnnxModel.load(regressor.path, "cpu").info
    describe(small, info)
    expected = in_batches(subject.served(), regressor.check.inputs).numpy()
    assert np.abs(OnnxModel.load(small, "cpu").run(regressor.check.inputs) - expected).mean() < 0.01


def test_both_files_are_served_by_their_detectors(classifier: Exported, regressor: Exported) -> None:
    for made in (classifier, regressor):
        engine = load_engine(made.path, "cpu", regressor=None)
        prepared = made.check.prepared[0]
        findings = engine.detector.finish(prepared, engine.network.run(prepared.inputs))
        assert findings.view.width == prepared.view.width
        assert type(engine.detector) is type(made.report.subject.detector)


def test_the_files_describe_themselves(classifier: Exported, regressor: Exported) -> None:
    info = OnnxModel.load(classifier.path, "cpu").info
    assert isinstance(info, ClassifierInfo)
    assert (info.precision, info.classes, info.strip.size) == ("int8", ("false", "lane"), 112)
    assert info.training == {
        "data": "none", "step": 7, "rank_energy": 0.9, "export_frames": "rendered scenes", "normalisation": "contrast",
    }  # fmt: skip
    assert info.metrics["frame_count"] == 4
    assert info.metrics["accuracy"] == pytest.approx(classifier.report.written.figures["accuracy"], abs=1e-4)
    assert info.threshold == classifier.report.subject.calibration.threshold
    other = OnnxModel.load(regressor.path, "cpu").info
    assert isinstance(other, RegressorInfo)
    assert (other.canvas.size, other.canvas.detail_width, other.precision) == (160, 448, "fp32")
    assert "onnxruntime" in other.exporter


def test_half_precision_loads_on_the_cpu_and_agrees(classifier: Exported, tmp_path: Path) -> None:
    subject = classifier.report.subject
    path = tmp_path / "fp16.onnx"
    write_graph(subject.served(half=True), classifier.check.inputs, path, (subject.input_name, subject.output_name))
    describe(path, subject.info(Description("half", "fp16", {}, {})))
    graph = onnx.load(str(path)).graph
    weights = [tensor for tensor in graph.initializer if tensor.name.endswith("weight")]
    assert {tensor.data_type for tensor in weights} == {onnx.TensorProto.FLOAT16}
    assert graph.input[0].type.tensor_type.elem_type == onnx.TensorProto.UINT8
    assert graph.output[0].type.tensor_type.elem_type == onnx.TensorProto.FLOAT
    inputs = classifier.check.inputs[:8]
    expected = in_batches(subject.served(), inputs).numpy()
    np.testing.assert_allclose(OnnxModel.load(path, "cpu").run(inputs), expected, atol=0.02)


def test_a_file_that_differs_is_not_written(
    classifier: Exported, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "write_graph", _other_network)
    out = tmp_path / "refused.onnx"
    with pytest.raises(ExportError, match=r"differs from PyTorch by 0\.\d+ on average"):
        export_network(classifier.report.subject, out, settings("fp32"), PROVENANCE, lambda _: None)
    assert not list(tmp_path.iterdir())


def _other_network(_: Any, example: NDArray[np.uint8], path: Path, names: tuple[str, str]) -> None:
    """Writes a file that answers every patch with certainty."""
    helper = onnx.helper
    input_name, output_name = names
    shape = helper.make_node("Shape", [input_name], ["shape"], start=0, end=1)
    two = helper.make_node("Constant", [], ["two"], value_ints=[2])
    both = helper.make_node("Concat", ["shape", "two"], ["size"], axis=0)
    ones = helper.make_node("ConstantOfShape", ["size"], [output_name], value=helper.make_tensor("v", 1, [1], [1.0]))
    graph = helper.make_graph(
        [shape, two, both, ones],
        "certain",
        [helper.make_tensor_value_info(input_name, onnx.TensorProto.UINT8, ["N", *example.shape[1:]])],
        [helper.make_tensor_value_info(output_name, onnx.TensorProto.FLOAT, ["N", 2])],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), str(path))


@pytest.mark.parametrize(
    ("lost", "words"),
    [
        ({"accuracy": 0.906}, "loses 0.60 points of accuracy against fp32, 0.5 are allowed"),
        ({"accuracy": float("nan")}, "loses nan points"),
    ],
)
def test_accuracy_beyond_the_tolerance_is_refused(classifier: Exported, lost: dict[str, float], words: str) -> None:
    report = classifier.report
    good = {"accuracy": 0.912, "average_precision": 0.9}
    fp32, checkpoint = replace(report.fp32, figures=good), replace(report.checkpoint, figures={"accuracy": 0.911})
    passing = replace(report, checkpoint=checkpoint, fp32=fp32, written=replace(report.written, figures=good))
    told = ExportSettings("x", 0.9, "int8")
    export._refuse(passing, told)
    with pytest.raises(ExportError) as caught:
        export._refuse(replace(passing, written=replace(report.written, figures=lost)), told)
    assert words in str(caught.value) or "checkpoint" in str(caught.value)
    assert "--rank-energy nearer to 1 or --precision fp16 or fp32" in caught.value.hint


def test_a_network_from_elsewhere_is_normalised_in_its_own_way(classifier: Exported) -> None:
    subject = classifier.report.subject
    assert isinstance(subject, ClassifierSubject)
    inputs = classifier.check.inputs[:4]
    theirs = replace(subject, normalisation="imagenet").under(Calibration())
    means, deviations = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    pixels = (inputs / 255.0 - np.array(means)) / np.array(deviations)
    with torch.inference_mode():
        x = torch.from_numpy(pixels.astype(np.float32)).permute(0, 3, 1, 2)
        expected = torch.softmax(theirs.network(x), dim=1).numpy()
    np.testing.assert_allclose(in_batches(theirs.served(), inputs).numpy(), expected, atol=1e-4)
    assert theirs.info(Description("theirs", "fp32", {}, {})).training == {"normalisation": "imagenet"}


def test_wrong_model_files_are_refused_in_one_line(classifier: Exported, tmp_path: Path) -> None:
    text = tmp_path / "text.onnx"
    text.write_text("no model")
    bare = tmp_path / "bare.onnx"
    model = onnx.load(str(classifier.path))
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


def test_a_file_says_nothing_of_the_machine_it_was_made_on(regressor: Exported) -> None:
    assert str(Path(torch.__file__).parents[1]).encode() not in regressor.path.read_bytes()
