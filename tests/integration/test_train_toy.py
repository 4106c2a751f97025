"""From labeled frames to a served model, with the commands that a team with its own frames would run."""

from __future__ import annotations

import csv
import json
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lanestream.inference.onnx_model import load

TOOL = Path(__file__).parents[2] / "tools" / "train_toy.py"


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the folder that `make train-toy` writes."""
    folder = tmp_path_factory.mktemp("train") / "toy"
    result = subprocess.run([sys.executable, TOOL, folder], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return folder


def curve(toy: Path) -> list[dict[str, float]]:
    with (toy / "run" / "curve.csv").open(newline="") as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


def test_it_learns(toy: Path) -> None:
    rows = curve(toy)
    best = min(rows, key=lambda row: row["validation"])
    # The loss of guessing one of three kinds, of four types and of two colors, with their weights.
    assert best["rendered_loss"] < math.log(3.0) + 0.3 * math.log(4.0) + 0.2 * math.log(2.0) - 0.02
    assert best["rendered_accuracy"] > 0.38
    assert {"real_loss", "real_accuracy"} <= best.keys()  # real patches are reported separately


def test_the_model_records_what_it_was_trained_on(toy: Path) -> None:
    info = load(toy / "toy.onnx").info
    assert info.name == "run", "the name of the folder"
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", info.version)
    assert info.training["config"]["steps"] == curve(toy)[-1]["step"]
    assert info.training["data"]["real_frames"] == [{"name": "toy roads"}]
    assert info.training["data"]["real"]["train"]["patches"] > 100


def test_it_is_better_than_chance_on_unseen_drives(toy: Path) -> None:
    figures: dict[str, Any] = json.loads((toy / "evaluation.json").read_text())
    (model,) = (name for name, method in figures["methods"].items() if method["kind"] == "classifier")
    candidates = figures["images"][model]["overall"]["candidates"]["far_40"]
    assert candidates["true"] + candidates["false"] >= 60
    assert candidates["average_precision"] > candidates["base_rate"] + 0.03


def test_it_serves(toy: Path) -> None:
    answer = json.loads((toy / "answer.json").read_text())
    assert (answer["width"], answer["height"]) == (640, 360)
    assert answer["timing_ms"]["infer"] > 0.0
    assert all(len(lane["points"]) >= 2 for lane in answer["lanes"])
