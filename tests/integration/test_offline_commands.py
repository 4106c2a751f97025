"""The offline commands refuse unusable input in one line, before any work."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import labelfiles
import pytest

from lanestream.cli import main


@dataclass(frozen=True)
class CommandResult:
    """The exit code and output of a command."""

    code: object
    errors: str
    output: str = ""


RunCommand = Callable[[str], CommandResult]


@pytest.fixture
def run(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> RunCommand:
    """Returns a function that runs a command line in `folder`, in this process: importing torch again takes seconds."""
    monkeypatch.chdir(folder)

    def command(line: str) -> CommandResult:
        monkeypatch.setattr(sys, "argv", ["lanestream", *line.split()])
        with pytest.raises(SystemExit) as ended:
            main()
        captured = capsys.readouterr()
        return CommandResult(ended.value.code, captured.err, captured.out)

    return command


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Returns a folder with useless files, an empty data folder and one with broken labels."""
    (tmp_path / "text").write_text("no JSON, no weights")
    (tmp_path / "binary").write_bytes(bytes(range(128, 256)))
    (tmp_path / "half.jsonl").write_text('{"frame": 0, "width": 640, "height": 360}\n')
    (tmp_path / "empty.jsonl").write_text("")
    (tmp_path / "initial.toml").write_text('initial = "text"')
    (tmp_path / "unknown.toml").write_text("[data]\nscenes = 3\n")
    (tmp_path / "manifest.toml").write_text('[data]\nmanifest = "gone.toml"\n')
    (tmp_path / "none").mkdir()
    (tmp_path / "broken" / "tusimple").mkdir(parents=True)
    (tmp_path / "broken" / "tusimple" / "labels.jsonl").write_text('{"split": "train"}\n')
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("data check missing", "there is nothing at missing"),
        ("data check none", "no labels of a known format in none"),
        ("data check none --sheet sheet.txt", "can't write an image to sheet.txt"),
        ("calibrate none -o /proc/camera/x.json --height 1.4", "can't write /proc/camera/x.json: no such file"),
        ("data check none --format cvat", "no labeled frames of format cvat in none"),
        ("score missing.jsonl half.jsonl", "can't read missing.jsonl"),
        ("score text half.jsonl", "text:1 is not a valid `lanes` message"),
        ("score binary half.jsonl", "binary is not a text file"),
        ("score empty.jsonl missing.jsonl", "can't read missing.jsonl"),
        ("score empty.jsonl text", "text:1: not JSON"),
        ("score empty.jsonl binary", "binary is not a text file"),
        ("score empty.jsonl half.jsonl", "half.jsonl:1: there is no 'lanes'"),
        ("evaluate --data none", "no labels of a known format in none"),
        ("calibrate missing -o camera.json --height 1.4", "no such file or folder: missing"),
        ("calibrate none -o camera.json --height 1.4", "no images in the folder none"),
        ("calibrate text -o camera.json --height 1.4", "text can't be read as a video"),
        ("calibrate none -o camera.json --camera text", "text: not a valid camera: Invalid JSON"),
        ("calibrate none -o camera.json --field-of-view 60", "not a valid camera: height: "),
        (
            "train classifier --run run --data none",
            "the data set 'TuSimple 0313-1' is missing: there is nothing at none/tus",
        ),
        ("train classifier --run run --data broken", "labels.jsonl:1: there is no"),
        ("train classifier initial.toml --run run --data broken", "text is not a PyTorch checkpoint"),
        ("train classifier manifest.toml --run run", "can't read gone.toml: no such file or directory"),
        ("evaluate --manifest text", "text is not a TOML file"),
        ("train classifier missing.toml --run run", "can't read missing.toml"),
        ("train classifier text --run run", "text is not a TOML file"),
        ("train classifier unknown.toml --run run", "unknown.toml: unknown key data.scenes (accepted here: manifest"),
        ("export missing.pt out.onnx --data broken", "no checkpoint at missing.pt"),
        ("export text out.onnx --data broken", "text is not a PyTorch checkpoint"),
    ],
)
def test_unusable_input_is_reported_in_one_line(run: RunCommand, arguments: str, expected: str) -> None:
    result = run(arguments)
    assert result.code == 1
    assert result.errors.startswith("error: ")
    assert expected in result.errors
    assert result.errors.count("\n") == 1


@pytest.mark.parametrize("arguments", ["evaluate --split all", "scene out.mp4 --seed -1"])
def test_numbers_out_of_range_are_refused(run: RunCommand, arguments: str) -> None:
    result = run(arguments)
    assert result.code == 2
    assert "Invalid value" in result.errors


def test_data_check_summarizes_the_data_set_and_draws_it(run: RunCommand, folder: Path) -> None:
    draw = labelfiles.drawer(folder / "good")
    for name in ("monday/a.jpg", "monday/b.jpg", "tuesday/c.jpg"):
        draw(name)
        labelfiles.labelme(
            (folder / "good" / name).with_suffix(".json"), Path(name).name, labelfiles.line_strip(labelfiles.LEFT)
        )
    result = run("data check good --sheet out/sheet.jpg")
    assert (result.code, result.errors) == (0, "")
    lines = (
        "good: labelme",
        "frames: 3",
        "lanes per frame: 1: 3",
        "image sizes: 320 x 180: 3",
        "rows covered: 100 to 170",
    )
    for line in lines:
        assert line in result.output
    assert "groups: 2: good/monday (2), good/tuesday (1)" in result.output
    sheet = cv2.imread(str(folder / "out" / "sheet.jpg"))
    assert sheet is not None
    assert sheet.shape[1] == 3 * 320


def test_data_check_reports_every_fault_and_fails(run: RunCommand, folder: Path) -> None:
    labelfiles.drawer(folder / "faulty")("a.jpg")
    good, far = (labelfiles.clip_record(image=name) for name in ("a.jpg", "gone.jpg"))
    labelfiles.write_lines(folder / "faulty" / "labels.jsonl", good, far, "{", good)
    result = run("data check faulty")
    assert result.code == 1
    assert result.errors == "error: 3 faults in faulty (listed above)\n"
    bad = [line for line in result.output.splitlines() if line.startswith("bad: ")]
    assert [line.split("labels.jsonl:")[1][0] for line in bad] == ["2", "3", "4"]


def test_data_check_reports_a_leak(run: RunCommand, folder: Path) -> None:
    for name in ("train", "val"):
        labelfiles.drawer(folder / name)(f"{name}.jpg")
        labelfiles.write_lines(
            folder / name / "labels.jsonl", labelfiles.clip_record(image=f"{name}.jpg", clip="road.mp4")
        )
    assert run("data check train").code == 0
    result = run("data check train --against val")
    assert result.code == 1
    assert "'road' is in both train and validation" in result.output
