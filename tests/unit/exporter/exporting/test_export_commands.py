"""The command `export`, given what it can't use, and the table that it prints."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from click import UsageError
from click.testing import CliRunner, Result
from labelfiles import write_manifest

from lanestream.detection import Prepared
from lanestream.detection.patches import PatchGeometry
from lanestream.engine import SHIPPED_REGRESSOR
from lanestream.errors import CheckpointError, ExportError, ModelError
from lanestream_exporter import export_commands
from lanestream_exporter.alexnet import AlexNet, Shape
from lanestream_exporter.exporting.classifier import ClassifierSubject
from lanestream_exporter.exporting.export import ExportReport
from lanestream_exporter.exporting.frames import FrameSource
from lanestream_exporter.exporting.proof import Boundaries, Measured
from lanestream_exporter.exporting.regressor import RegressorSubject
from lanestream_exporter.regressor import LaneRegressor

SMALL = Shape(64, 0.1, 16)


def called(*arguments: str | Path) -> Result:
    return CliRunner().invoke(export_commands.export, [str(part) for part in arguments], env={"LANESTREAM_DATA": ""})


@pytest.mark.parametrize(
    ("strip", "words"),
    [
        ("width=30", "there is no 'width'; accepted: size, half_width"),
        ("half_width=wide", "half_width must be a number, not 'wide'"),
        ("size=0", "size must be above 0"),
        ("half_width=nan", "half_width must be above 0"),
        ("min_half_width=inf", "min_half_width must be above 0"),
    ],
)
def test_strips_that_can_not_be_are_refused(tmp_path: Path, strip: str, words: str) -> None:
    result = called("any.pt", tmp_path / "out.onnx", "--classes", "false,lane", "--strip", strip)
    assert result.exit_code == 2
    assert words in " ".join(result.output.split())


def test_a_strip_names_what_is_unusual() -> None:
    command = export_commands.export
    with command.make_context("export", ["a.pt", "b.onnx", "--strip", "half_width=0.4, lean=0"]) as context:
        assert context.params["strip"] == PatchGeometry(224, half_width=0.4, lean=0.0)


def test_classes_and_strips_go_together(tmp_path: Path) -> None:
    result = called("any.pt", tmp_path / "out.onnx", "--classes", "false,lane")
    assert result.exit_code == 2
    assert "both --classes and --strip" in result.output


def test_a_folder_is_no_file_to_write(tmp_path: Path) -> None:
    assert isinstance(called("any.pt", tmp_path).exception, ExportError)


def test_what_is_no_checkpoint_is_told_before_any_work(tmp_path: Path) -> None:
    path = tmp_path / "other.pt"
    torch.save({"weights": torch.zeros(3)}, path)
    result = called(path, tmp_path / "out.onnx")
    assert isinstance(result.exception, CheckpointError)
    assert not result.output


def test_a_classifier_is_proved_as_it_is_served() -> None:
    frames = FrameSource(None, rendered=4)
    subject = ClassifierSubject(AlexNet(shape=SMALL), strip=PatchGeometry(SMALL.size))
    served, shipped, alone = (
        [bottoms(prepared) for prepared in export_commands._guided(subject, guide).check(frames).prepared]
        for guide in (SHIPPED_REGRESSOR, None, Path("none"))
    )
    assert served == shipped
    assert served != alone
    assert alone == [bottoms(prepared) for prepared in subject.check(frames).prepared]


def bottoms(prepared: Prepared) -> list[float]:
    """Where the candidates cross the bottom row."""
    return [round(float(candidate.curve.x(prepared.view.bottom)), 1) for candidate in prepared.candidates]


def test_a_guide_is_for_classifiers(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"can't read .*gone\.onnx"):
        export_commands._guided(ClassifierSubject(AlexNet(shape=SMALL)), tmp_path / "gone.onnx")
    with pytest.raises(UsageError, match="a regressor has no guide"):
        export_commands._guided(RegressorSubject(LaneRegressor(SMALL)), SHIPPED_REGRESSOR)


def test_the_table_compares_size_accuracy_and_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [
        Measured("checkpoint", {"accuracy": 0.95, "average_precision": 0.99}),
        Measured("fp32", {"accuracy": 0.949, "average_precision": 0.99}, 1e-6, 2e-5, 12_000_000, 4.0),
        Measured("int8", {"accuracy": 0.947, "average_precision": 0.98}, 1e-3, 5e-2, 3_000_000, 1.2),
    ]
    with torch.device("meta"):
        subject = ClassifierSubject(AlexNet(batch_norm=False))
    report = ExportReport(subject, 20, 300, *rows, Boundaries(80, 1, 0.1, 2.5), "openvino")
    out = tmp_path / "out.onnx"
    out.write_bytes(bytes(1234))  # the figures are written into the file after it has been measured
    export_commands._tell(out, report, FrameSource(None))
    told = capsys.readouterr().out
    assert "300 inputs of 20 validation frames: rendered scenes" in told
    assert "int8 against checkpoint: 0.30 points of accuracy lost" in told
    assert "int8 against fp32: 0.20 points of accuracy lost" in told
    assert "int8 against fp32, the same network: 0.30 of the time (openvino)" in told
    assert "80 by PyTorch and by the file, 1 by one alone" in told
    assert "1,234 bytes" in told
    for cell in ("12.0 MB", "3.0 MB", "4.00 ms", "1.20 ms", "0.9470"):
        assert cell in told


def test_frames_of_ones_own_prove_the_file_where_they_are_still_there(tmp_path: Path) -> None:
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
