"""The commands around networks and labels, given what they can't use: one line, before any work."""

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
class Done:
    """How a command ended."""

    code: object
    errors: str
    output: str = ""


Run = Callable[[str], Done]


@pytest.fixture
def run(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command line in `folder`, in this process: importing torch anew for each would take seconds."""
    monkeypatch.chdir(folder)

    def command(line: str) -> Done:
        monkeypatch.setattr(sys, "argv", ["lanestream", *line.split()])
        with pytest.raises(SystemExit) as ended:
            main()
        told = capsys.readouterr()
        return Done(ended.value.code, told.err, told.out)

    return command


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Has a file that is nothing useful, an empty data folder and one whose labels are broken."""
    (tmp_path / "text").write_text("no JSON, no weights")
    (tmp_path / "binary").write_bytes(bytes(range(128, 256)))
    (tmp_path / "half.jsonl").write_text('{"frame": 0, "width": 640, "height": 360}\n')
    (tmp_path / "empty.jsonl").write_text("")
    (tmp_path / "initial.toml").write_text('initial = "text"')
    (tmp_path / "unknown.toml").write_text("[data]\nscenes = 3\n")
    (tmp_path / "none").mkdir()
    (tmp_path / "broken" / "tusimple").mkdir(parents=True)
    (tmp_path / "broken" / "tusimple" / "labels.jsonl").write_text('{"split": "train"}\n')
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("data check missing", "there is nothing at missing"),
        ("data check none", "no labels that are known in none"),
        ("data check none --sheet sheet.txt", "can't write a picture to sheet.txt"),
        ("data check none --format cvat", "no labelled frames in none as cvat"),
        ("score missing.jsonl half.jsonl", "can't read missing.jsonl"),
        ("score text half.jsonl", "text:1 is not a valid `lanes` message"),
        ("score binary half.jsonl", "binary is not a text file"),
        ("score empty.jsonl missing.jsonl", "can't read missing.jsonl"),
        ("score empty.jsonl text", "text:1: not JSON"),
        ("score empty.jsonl binary", "binary is not a text file"),
        ("score empty.jsonl half.jsonl", "half.jsonl:1: there is no 'lanes'"),
        ("evaluate --data none", "no labels that are known in none"),
        ("train classifier --run run --data none", "no labelled frames in none"),
        ("train classifier --run run --data broken", "labels.jsonl:1: there is no"),
        ("train classifier initial.toml --run run --data broken", "text is not a PyTorch checkpoint"),
        ("train classifier missing.toml --run run", "can't read missing.toml"),
        ("train classifier text --run run", "text is not a TOML file"),
        ("train classifier unknown.toml --run run", "unknown.toml: there is no data.scenes (accepted here: rendered"),
        ("export missing.pt out.onnx --data broken", "no checkpoint at missing.pt"),
        ("export text out.onnx --data broken", "text is not a PyTorch checkpoint"),
    ],
)
def test_what_cannot_be_used_is_told_in_one_line(run: Run, arguments: str, words: str) -> None:
    done = run(arguments)
    assert done.code == 1
    assert done.errors.startswith("error: ")
    assert words in done.errors
    assert done.errors.count("\n") == 1


@pytest.mark.parametrize("arguments", ["evaluate --split all", "scene out.mp4 --seed -1"])
def test_numbers_out_of_range_are_refused(run: Run, arguments: str) -> None:
    done = run(arguments)
    assert done.code == 2
    assert "Invalid value" in done.errors


def test_data_check_tells_what_is_there_and_draws_it(run: Run, folder: Path) -> None:
    draw = labelfiles.drawer(folder / "good")
    for name in ("monday/a.jpg", "monday/b.jpg", "tuesday/c.jpg"):
        draw(name)
        labelfiles.labelme(
            (folder / "good" / name).with_suffix(".json"), Path(name).name, labelfiles.strip(labelfiles.LEFT)
        )
    done = run("data check good --sheet out/sheet.jpg")
    assert (done.code, done.errors) == (0, "")
    lines = (
        "good: labelme",
        "frames: 3",
        "lanes per frame: 1: 3",
        "image sizes: 320 x 180: 3",
        "rows covered: 100 to 170",
    )
    for line in lines:
        assert line in done.output
    assert "groups: 2: good/monday (2), good/tuesday (1)" in done.output
    sheet = cv2.imread(str(folder / "out" / "sheet.jpg"))
    assert sheet is not None
    assert sheet.shape[1] == 3 * 320


def test_data_check_names_every_fault_and_fails(run: Run, folder: Path) -> None:
    labelfiles.drawer(folder / "faulty")("a.jpg")
    good, far = (labelfiles.clip_record(image=name) for name in ("a.jpg", "gone.jpg"))
    labelfiles.write_lines(folder / "faulty" / "labels.jsonl", good, far, "{", good)
    done = run("data check faulty")
    assert done.code == 1
    assert done.errors == "error: 3 faults in faulty (named above)\n"
    told = [line for line in done.output.splitlines() if line.startswith("bad: ")]
    assert [line.split("labels.jsonl:")[1][0] for line in told] == ["2", "3", "4"]


def test_data_check_names_a_leak(run: Run, folder: Path) -> None:
    for name in ("train", "val"):
        labelfiles.drawer(folder / name)(f"{name}.jpg")
        labelfiles.write_lines(
            folder / name / "labels.jsonl", labelfiles.clip_record(image=f"{name}.jpg", clip="road.mp4")
        )
    assert run("data check train").code == 0
    done = run("data check train --against val")
    assert done.code == 1
    assert "'road' is in both train and validation" in done.output
