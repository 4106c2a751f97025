"""The commands around networks and labels, given what they can't use: one line, before any work."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from lanestream.cli import main


@dataclass(frozen=True)
class Done:
    """How a command ended."""

    code: object
    errors: str


Run = Callable[[str], Done]


@pytest.fixture
def run(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command line in `folder`, in this process: importing torch anew for each would take seconds."""
    monkeypatch.chdir(folder)

    def command(line: str) -> Done:
        monkeypatch.setattr(sys, "argv", ["lanestream", *line.split()])
        with pytest.raises(SystemExit) as ended:
            main()
        return Done(ended.value.code, capsys.readouterr().err)

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
        ("score missing.jsonl half.jsonl", "can't read missing.jsonl"),
        ("score text half.jsonl", "text:1 is no `lanes` message"),
        ("score binary half.jsonl", "binary is not a text file"),
        ("score empty.jsonl missing.jsonl", "can't read missing.jsonl"),
        ("score empty.jsonl text", "text:1: not JSON"),
        ("score empty.jsonl binary", "binary is not a text file"),
        ("score empty.jsonl half.jsonl", "half.jsonl:1: there is no 'lanes'"),
        ("evaluate --data none", "no labelled frames in none"),
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
