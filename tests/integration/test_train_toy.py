"""From labelled frames to a model that serves, by the commands that a team with frames of its own would type."""

from __future__ import annotations

import csv
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lanestream.inference import OnnxModel

TOOL = Path(__file__).parents[2] / "tools" / "train_toy.py"


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that `make train-toy` leaves behind."""
    folder = tmp_path_factory.mktemp("train") / "toy"
    done = subprocess.run([sys.executable, TOOL, folder], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def curve(toy: Path) -> list[dict[str, float]]:
    with (toy / "run" / "curve.csv").open(newline="") as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


def test_it_learns(toy: Path) -> None:
    rows = curve(toy)
    best = min(rows, key=lambda row: row["validation"])
    assert best["validation"] < math.log(2.0) - 0.02  # a coin's loss
    assert best["rendered_accuracy"] > 0.55
    assert {"real_loss", "real_accuracy"} <= best.keys()  # frames of one's own are told apart


def test_the_model_tells_what_it_was_trained_on(toy: Path) -> None:
    info = OnnxModel.load(toy / "toy.onnx", "cpu").info
    assert info.training["config"]["steps"] == curve(toy)[-1]["step"]
    assert info.training["data"]["real_frames"] == str(toy / "learn")
    assert info.training["data"]["real"]["train"] > 100


def test_it_does_better_than_chance_on_a_drive_that_it_has_not_seen(toy: Path) -> None:
    figures: dict[str, Any] = json.loads((toy / "evaluation.json").read_text())
    (model,) = (name for name, method in figures["methods"].items() if method["kind"] == "classifier")
    judged = figures["images"][model]["overall"]["candidates"]["far_40"]
    assert judged["true"] + judged["false"] >= 60
    assert judged["average_precision"] > judged["base_rate"] + 0.03


def test_it_serves(toy: Path) -> None:
    answer = json.loads((toy / "answer.json").read_text())
    assert (answer["width"], answer["height"]) == (640, 360)
    assert answer["timing_ms"]["infer"] > 0.0
    assert all(len(lane["points"]) >= 2 for lane in answer["lanes"])
