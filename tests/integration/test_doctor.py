"""`lanestream doctor` in a process of its own: what it tells, and that what is required is required."""

import hashlib
import json
import os
import subprocess
import sys
from typing import Any

import pytest

from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR


def doctor(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "error", "-m", "lanestream.cli", "doctor", *arguments]
    environment = {**os.environ, **variables}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=120)


def told(done: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    diagnosis: dict[str, Any] = json.loads(done.stdout)
    return diagnosis


def test_the_shipped_networks_are_loaded_and_timed() -> None:
    done = doctor("--json", "--provider", "cpu", "--require", "cpu", LANESTREAM_INFERENCE_THREADS="1")
    assert (done.returncode, done.stderr) == (0, "")
    diagnosis = told(done)
    assert diagnosis["problem"] is None
    assert {"lanestream", "python", "onnxruntime"} <= set(diagnosis["software"])
    networks = diagnosis["networks"]
    assert [network["kind"] for network in networks] == ["classifier", "regressor"]
    for network, path in zip(networks, (SHIPPED_MODEL, SHIPPED_REGRESSOR), strict=True):
        assert network["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        assert (network["provider"], network["precision"], network["threads"]) == ("cpu", "int8", 1)
        assert set(network["nodes"]) == {"CPU"}
        assert not network["fell_back"]
        assert list(network["run_ms"]) == ["1", "2", "4", "8", "12", "16"]
        assert all(taken > 0.0 for taken in network["run_ms"].values())


def test_people_are_told_in_tables_that_a_pipe_does_not_break() -> None:
    done = doctor("--model", str(SHIPPED_REGRESSOR))
    assert (done.returncode, done.stderr) == (0, "")
    lines = [line.rstrip() for line in done.stdout.splitlines()]
    assert any(line.startswith("GPU") for line in lines)
    assert any(line.endswith(str(SHIPPED_REGRESSOR)) for line in lines)
    assert not any(line.startswith("classifier") for line in lines)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--require", "cuda"), "the installed onnxruntime has no CUDA"),
        (("--require", "tensorrt"), "the installed onnxruntime has no TensorRT"),
        (
            ("--require", "cuda", "--provider", "cpu", "--regressor", "none"),
            "runs on cpu, not on cuda: cpu was asked for",
        ),
        (("--model", "none.onnx"), "no model file at none.onnx"),
        (("--regressor", "none.onnx", "--provider", "cpu"), "no model file at none.onnx"),
    ],
)
def test_what_is_wrong_is_one_line_below_what_was_found(arguments: tuple[str, ...], words: str) -> None:
    done = doctor("--json", *arguments)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert words in done.stderr
    diagnosis = told(done)
    assert words in diagnosis["problem"]
    assert diagnosis["cpu"]["used"] >= 1


def test_openvino_can_be_required() -> None:
    done = doctor("--json", "--require", "openvino", "--regressor", "none")
    assert (done.returncode, done.stderr) == (0, "")
    network = told(done)["networks"][0]
    assert network["provider"] == "openvino"
    assert network["nodes"]["CPU u8"] > 10


def test_a_setting_that_is_not_accepted_is_told_at_once() -> None:
    done = doctor(LANESTREAM_PROVIDER="quantum")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: LANESTREAM_PROVIDER = 'quantum': ")
