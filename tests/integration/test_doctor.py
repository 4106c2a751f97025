"""`lanestream doctor` as a command: what it reports, and that `--require` fails on other providers."""

import hashlib
import json
import os
import subprocess
import sys
from typing import Any

import pytest

from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR


def run_doctor(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "error", "-m", "lanestream.cli", "doctor", *arguments]
    environment = {**os.environ, **variables}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=120)


def diagnosis_of(result: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    diagnosis: dict[str, Any] = json.loads(result.stdout)
    return diagnosis


def test_the_shipped_networks_are_loaded_and_timed() -> None:
    result = run_doctor("--json", "--provider", "cpu", "--require", "cpu", LANESTREAM_INFERENCE_THREADS="1")
    assert (result.returncode, result.stderr) == (0, "")
    diagnosis = diagnosis_of(result)
    assert diagnosis["problem"] is None
    assert {"lanestream", "python", "onnxruntime"} <= set(diagnosis["software"])
    networks = diagnosis["networks"]
    assert [network["kind"] for network in networks] == ["classifier", "regressor"]
    for network, path in zip(networks, (SHIPPED_MODEL, SHIPPED_REGRESSOR), strict=True):
        assert network["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        assert (network["provider"], network["precision"], network["threads"]) == ("cpu", "int8", 1)
        assert set(network["nodes"]) == {"CPU"}
        assert not network["fell_back"]
        assert list(network["run_ms"]) == ["1", "2", "4", "8"]
        assert all(milliseconds > 0.0 for milliseconds in network["run_ms"].values())


def test_the_tables_have_unbroken_lines_in_a_pipe() -> None:
    result = run_doctor("--model", str(SHIPPED_REGRESSOR))
    assert (result.returncode, result.stderr) == (0, "")
    lines = [line.rstrip() for line in result.stdout.splitlines()]
    assert any(line.startswith("GPU") for line in lines)
    assert any(line.endswith(str(SHIPPED_REGRESSOR)) for line in lines)
    assert not any(line.startswith("classifier") for line in lines)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--require", "cuda"), "the installed onnxruntime has no CUDA"),
        (("--require", "tensorrt"), "the installed onnxruntime has no TensorRT"),
        (
            ("--require", "cuda", "--provider", "cpu", "--regressor", "none"),
            "runs on cpu, not on cuda: cpu was requested",
        ),
        (("--model", "none.onnx"), "no model file at none.onnx"),
        (("--regressor", "none.onnx", "--provider", "cpu"), "no model file at none.onnx"),
    ],
)
def test_a_problem_is_one_line_after_the_report(arguments: tuple[str, ...], message: str) -> None:
    result = run_doctor("--json", *arguments)
    assert result.returncode == 1
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1
    assert message in result.stderr
    diagnosis = diagnosis_of(result)
    assert message in diagnosis["problem"]
    assert diagnosis["cpu"]["used"] >= 1


def test_openvino_can_be_required() -> None:
    result = run_doctor("--json", "--require", "openvino", "--regressor", "none")
    assert (result.returncode, result.stderr) == (0, "")
    network = diagnosis_of(result)["networks"][0]
    assert network["provider"] == "openvino"
    assert network["nodes"]["CPU u8"] > 10


def test_an_invalid_setting_is_an_error_without_a_report() -> None:
    result = run_doctor(LANESTREAM_PROVIDER="quantum")
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr.startswith("error: LANESTREAM_PROVIDER = 'quantum': ")
