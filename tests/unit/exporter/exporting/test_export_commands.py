"""The command `export`: invalid input, and the table that it prints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from click import UsageError
from click.testing import CliRunner, Result
from labelfiles import write_manifest

from lanestream.engine import SHIPPED_REGRESSOR
from lanestream.errors import CheckpointError, ExportError, ModelError
from lanestream.road.crops import PatchGeometry
from lanestream_exporter import export_commands
from lanestream_exporter.alexnet import AlexNet, Shape
from lanestream_exporter.exporting.classifier import ExportableClassifier
from lanestream_exporter.exporting.export import ExportReport
from lanestream_exporter.exporting.frames import ExportFrames
from lanestream_exporter.exporting.proof import BoundaryComparison, ModelMeasurement
from lanestream_exporter.exporting.regressor import ExportableRegressor
from lanestream_exporter.regressor import LaneRegressor

SMALL = Shape(64, 0.1, 16)


def called(*arguments: str | Path) -> Result:
    return CliRunner().invoke(export_commands.export, [str(part) for part in arguments], env={"LANESTREAM_DATA": ""})


@pytest.mark.parametrize(
    ("patch", "message"),
    [
        ("width=30", "unknown key 'width'; accepted: size, half_width"),
        ("half_width=wide", "half_width must be a number, not 'wide'"),
        ("size=0", "size must be above 0"),
        ("half_width=nan", "half_width must be above 0"),
        ("min_half_width=inf", "min_half_width must be above 0"),
    ],
)
def test_invalid_patch_geometries_are_rejected(tmp_path: Path, patch: str, message: str) -> None:
    result = called("any.pt", tmp_path / "out.onnx", "--classes", "false,lane", "--patch", patch)
    assert result.exit_code == 2
    assert message in " ".join(result.output.split())


def test_a_patch_geometry_names_only_what_differs_from_the_defaults() -> None:
    command = export_commands.export
    with command.make_context("export", ["a.pt", "b.onnx", "--patch", "half_width=0.4, obliquity=0"]) as context:
        assert context.params["patch"] == PatchGeometry(224, half_width=0.4, obliquity=0.0)


def test_classes_and_patch_geometry_must_be_given_together(tmp_path: Path) -> None:
    result = called("any.pt", tmp_path / "out.onnx", "--classes", "false,lane")
    assert result.exit_code == 2
    assert "both --classes and --patch" in result.output


@pytest.mark.parametrize(
    ("checkpoint", "name"),
    [
        ("runs/mine/best.pt", "mine"),
        ("runs/my roads (2)/last.pt", "my-roads-2"),
        ("downloads/alexnet.v2.pt", "alexnet.v2"),
        ("runs/Straße/best.pt", "Stra-e"),
        ("/best.pt", "model"),
    ],
)
def test_a_model_is_named_after_its_run(checkpoint: str, name: str) -> None:
    assert export_commands.default_name(Path(checkpoint)) == name


def test_the_folder_of_a_run_may_be_the_current_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "runs").mkdir()
    monkeypatch.chdir(tmp_path / "runs")
    assert export_commands.default_name(Path("best.pt")) == "runs"


@pytest.mark.parametrize("option", ["--name", "--version"])
@pytest.mark.parametrize("value", ["my roads", "", "-x", "a" * 65, "a\nb"])
def test_names_and_versions_are_short_words(tmp_path: Path, option: str, value: str) -> None:
    result = called("any.pt", tmp_path / "out.onnx", f"{option}={value}")
    assert result.exit_code == 2
    assert "is not accepted" in result.output


def test_a_folder_as_output_is_rejected(tmp_path: Path) -> None:
    assert isinstance(called("any.pt", tmp_path).exception, ExportError)


def test_an_invalid_checkpoint_fails_before_any_work(tmp_path: Path) -> None:
    path = tmp_path / "other.pt"
    torch.save({"weights": torch.zeros(3)}, path)
    result = called(path, tmp_path / "out.onnx")
    assert isinstance(result.exception, CheckpointError)
    assert not result.output


def test_a_classifier_is_verified_with_the_regressor_that_it_is_served_with() -> None:
    frames = ExportFrames(None, rendered=4)
    network = ExportableClassifier(AlexNet(shape=SMALL), patch_geometry=PatchGeometry(SMALL.size))
    networks = [export_commands._with_prior(network, path) for path in (SHIPPED_REGRESSOR, None, Path("none"))]
    served, shipped, alone = (each.validation_set(frames).inputs for each in networks)
    np.testing.assert_array_equal(served, shipped)
    assert not np.array_equal(served, alone)
    np.testing.assert_array_equal(alone, network.validation_set(frames).inputs)


def test_only_classifiers_take_a_regressor(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"can't read .*gone\.onnx"):
        export_commands._with_prior(ExportableClassifier(AlexNet(shape=SMALL)), tmp_path / "gone.onnx")
    with pytest.raises(UsageError, match="--regressor is only for classifiers"):
        export_commands._with_prior(ExportableRegressor(LaneRegressor(SMALL)), SHIPPED_REGRESSOR)


def test_the_table_compares_size_accuracy_and_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [
        ModelMeasurement("checkpoint", {"accuracy": 0.95, "average_precision": 0.99}),
        ModelMeasurement("fp32", {"accuracy": 0.949, "average_precision": 0.99}, 1e-6, 2e-5, 12_000_000, 4.0),
        ModelMeasurement("int8", {"accuracy": 0.947, "average_precision": 0.98}, 1e-3, 5e-2, 3_000_000, 1.2),
    ]
    with torch.device("meta"):
        network = ExportableClassifier(AlexNet(batch_norm=False))
    report = ExportReport(network, 20, 300, *rows, BoundaryComparison(80, 1, 0.1, 2.5), "openvino")
    out = tmp_path / "out.onnx"
    out.write_bytes(bytes(1234))  # the metrics are written into the file after it has been measured
    export_commands._print_report(out, report, ExportFrames(None))
    output = capsys.readouterr().out
    assert "300 inputs of 20 validation frames: rendered scenes" in output
    assert "int8 against checkpoint: 0.30 points of accuracy lost" in output
    assert "int8 against fp32: 0.20 points of accuracy lost" in output
    assert "int8 against fp32, the same network: 0.30 of the time (openvino)" in output
    assert "80 found by both PyTorch and the file, 1 by only one" in output
    assert "1,234 bytes" in output
    for cell in ("12.0 MB", "3.0 MB", "4.00 ms", "1.20 ms", "0.9470"):
        assert cell in output


def test_own_frames_verify_the_file_if_they_still_exist(tmp_path: Path) -> None:
    manifest = write_manifest(tmp_path / "datasets.toml", {"name": "mine", "path": "roads", "split": "train"})
    found = export_commands._datasets({"config": {"data": {"manifest": str(manifest)}}}, tmp_path)
    assert found is not None
    assert (found.manifest.dataset[0].name, found.root) == ("mine", tmp_path)
    gone = {"config": {"data": {"manifest": str(tmp_path / "gone.toml")}}}
    assert export_commands._datasets(gone, None) is None
    assert export_commands._datasets({"data": "not recorded"}, None) is None
    shipped = export_commands._datasets({"data": "not recorded"}, tmp_path)
    assert shipped is not None
    assert shipped.root == tmp_path
