"""`lanestream models`, and `shipped` as the name of the shipped files."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR, resolve_model, resolve_regressor


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "lanestream", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


def test_the_shipped_files_are_listed() -> None:
    result = run("models", "--json")
    assert (result.returncode, result.stderr) == (0, "")
    listed = {Path(model["file"]): model for model in json.loads(result.stdout)["models"]}
    assert set(listed) == set(SHIPPED_MODEL.parent.glob("*.onnx"))
    for path, model in listed.items():
        assert model["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        assert model["bytes"] == path.stat().st_size
        assert Path(model["card"]).is_file()
    assert {model["default"]: path for path, model in listed.items() if model["default"]} == {
        "--model": SHIPPED_MODEL,
        "--regressor": SHIPPED_REGRESSOR,
    }
    assert listed[SHIPPED_MODEL]["kind"] == "classifier"


def test_a_given_file_is_described_in_a_table(tmp_path: Path) -> None:
    copy = tmp_path / "mine.onnx"
    copy.write_bytes(SHIPPED_MODEL.read_bytes())
    result = run("models", str(copy))
    assert (result.returncode, result.stderr) == (0, "")
    assert str(copy) in result.stdout
    assert hashlib.sha256(copy.read_bytes()).hexdigest() in result.stdout
    assert "--model" not in result.stdout
    assert "model card" not in result.stdout
    result = run("models", "gone.onnx")
    assert (result.returncode, result.stderr) == (
        1,
        "error: no model file at gone.onnx (give the path of an exported .onnx file)\n",
    )


def test_shipped_names_the_shipped_files() -> None:
    shipped = Path("shipped")
    assert resolve_model(None) == resolve_model(shipped) == SHIPPED_MODEL
    assert resolve_regressor(None) == resolve_regressor(shipped) == SHIPPED_REGRESSOR
    assert resolve_model(Path("mine.onnx")) == Path("mine.onnx")


@pytest.mark.parametrize("regressor", ["shipped", "none"])
def test_commands_take_the_name(regressor: str) -> None:
    result = run("doctor", "--json", "--model", "shipped", "--regressor", regressor, "--provider", "cpu")
    assert (result.returncode, result.stderr) == (0, "")
    files = [Path(network["file"]) for network in json.loads(result.stdout)["networks"]]
    assert files == [SHIPPED_MODEL, SHIPPED_REGRESSOR][: 1 + (regressor == "shipped")]
