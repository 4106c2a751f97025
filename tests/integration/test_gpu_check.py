"""`make gpu-check` on a machine without a GPU: all its steps on the CPU, and what it reports if something is wrong."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import fakes
import gpu_steps
import gpusteps
import numpy as np
import pytest
from click.testing import CliRunner, Result
from gpu_check import Step, main, run_step
from gpu_steps import FP32_CLASSIFIER, MOST_DIFFERENCE, Plan
from half_precision import write_half_precision
from processes import commands_of_run

from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR
from lanestream.inference.loading import load_model

ALL = ["doctor", "inputs", "nodes", "parity", "batches", "binding", "tensorrt", "load"]


def check(folder: Path, *arguments: str) -> tuple[Result, dict[str, Any]]:
    result = CliRunner().invoke(main, ["--out", str(folder), *arguments])
    return result, json.loads((folder / "gpu_check.json").read_text())


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    """A plan whose inputs are there."""
    plan = Plan("cpu", tmp_path_factory.mktemp("gpu-check"), quick=True)
    gpu_steps.inputs(plan)
    return plan


def test_every_step_passes_on_the_cpu_and_a_second_check_keeps_what_the_first_found(tmp_path: Path) -> None:
    arguments = ("--provider", "cpu", "--quick", "--sessions", "2")
    result, content = check(tmp_path, *arguments)
    assert result.exit_code == 0, result.output
    assert content["passed"]
    assert list(content["steps"]) == ALL
    figures = {name: step["report"]["figures"] for name, step in content["steps"].items()}
    files = {SHIPPED_MODEL.name, FP32_CLASSIFIER.name, "classifier-fp16.onnx", SHIPPED_REGRESSOR.name}
    assert figures["parity"].keys() == files
    assert all(each["largest"] == 0.0 for each in figures["parity"].values())
    assert all(each["nodes"] > 30 and not each["elsewhere"] for each in figures["nodes"].values())
    assert all(list(each["ms"]) == ["1", "4"] for each in figures["batches"].values())
    assert all(each.keys() == {"plain", "bound"} for each in figures["binding"].values())
    assert len(figures["binding"]) == 2 * len(files)
    assert content["steps"]["tensorrt"]["status"] == "skipped"
    for load in ("most", "paced"):
        assert figures["load"]["default"][load]["replies"] > 0
        assert figures["load"]["default"][load]["failed"] == 0
    assert "2 cameras, classifier.onnx:" in result.output
    assert (tmp_path / "gpu_check.txt").read_text() in result.output

    again, kept = check(tmp_path, *arguments)
    assert (again.exit_code, again.output, kept) == (0, result.output, content)

    other, content = check(tmp_path, "--provider", "cpu", "--quick", "--step", "doctor")
    assert (other.exit_code, list(content["steps"])) == (0, ["doctor", "inputs"]), "with another number of cameras"


def test_without_cuda_there_is_one_line_and_nothing_else_runs(tmp_path: Path) -> None:
    result, content = check(tmp_path)
    assert result.exit_code == 1
    (failure,) = [line for line in result.output.splitlines() if "FAILED" in line]
    assert "the installed onnxruntime has no CUDA (install lanestream[gpu]" in failure
    assert [step["status"] for step in content["steps"].values()] == ["failed", *["not run"] * (len(ALL) - 1)]
    assert not content["passed"]


def test_frames_that_are_missing_fail_with_one_line(tmp_path: Path) -> None:
    result, content = check(tmp_path, "--provider", "cpu", "--frames", "nowhere", "--step", "nodes")
    assert result.exit_code == 1
    assert "no such file or folder: nowhere" in content["steps"]["inputs"]["report"]["failures"][0]
    assert content["steps"]["nodes"]["status"] == "not run"


@pytest.mark.parametrize(
    ("run", "limit_s", "message"),
    [
        (gpusteps.crash, 60.0, "its process ended with code -6"),
        (gpusteps.crash_beside_a_child, 60.0, "its process ended with code -6"),
        (gpusteps.fail, 60.0, "RuntimeError: the device is on fire"),
        (gpusteps.hang, 3.0, "not done after 3 s"),
    ],
)
def test_a_step_that_goes_wrong_is_one_line_and_leaves_no_process(
    run: Any, limit_s: float, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TEST_RUN", str(tmp_path))
    outcome = run_step(Step("wrong", run, limit_s), Plan("cpu", tmp_path))
    assert outcome.status == "failed"
    assert outcome.report.failures == [f"{message} (output in {tmp_path / 'gpu_check_wrong.log'})"]
    # A process that was killed disappears a moment later.
    deadline = time.monotonic() + fakes.WAIT_S
    while any("resource_tracker" not in command for command in commands_of_run(str(tmp_path))):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_outputs_that_differ_too_much_fail(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(MOST_DIFFERENCE, "int8", 0.0)
    report = gpu_steps.compared(plan, "openvino")
    assert any(failure.startswith(f"{SHIPPED_REGRESSOR.name}: outputs differ by 0.00") for failure in report.failures)


def test_nodes_that_run_elsewhere_fail(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = [("Conv", "CPUExecutionProvider"), ("Gather", "OtherProvider"), ("MemcpyToHost", "CPUExecutionProvider")]
    monkeypatch.setattr(gpu_steps, "profiled_nodes", lambda *_: ran)
    report = gpu_steps.nodes(plan)
    assert report.failures[0] == f"{SHIPPED_MODEL.name}: nodes that did not run on cpu: 1 Gather"
    assert report.figures[SHIPPED_MODEL.name]["copies"] == 1


def test_bound_runs_with_wrong_outputs_fail(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_steps, "bound_run", lambda session, info, size, device: lambda batch: np.ones(1))
    report = gpu_steps.binding(plan)
    assert len(report.failures) == len(report.figures)
    assert f"{SHIPPED_MODEL.name}: bound runs of 4 differ by" in report.failures[1]


def test_without_a_file_in_half_precision_parity_fails(tmp_path: Path, plan: Plan) -> None:
    without = Plan("cpu", tmp_path)
    (tmp_path / "gpu_check_inputs.npz").write_bytes((plan.folder / "gpu_check_inputs.npz").read_bytes())
    assert gpu_steps.parity(without).failures == ["no fp16 file was checked: install onnx, or give a file with --model"]


def test_the_copy_in_half_precision_computes_nearly_the_same(tmp_path: Path, plan: Plan) -> None:
    write_half_precision(FP32_CLASSIFIER, tmp_path / "half.onnx")
    half, single = load_model(tmp_path / "half.onnx", "cpu"), load_model(FP32_CLASSIFIER, "cpu")
    assert half.info.precision == "fp16"
    assert (tmp_path / "half.onnx").stat().st_size < 0.6 * FP32_CLASSIFIER.stat().st_size
    inputs = gpu_steps.recorded_inputs(plan, "classifier")
    assert 0.0 < np.abs(half.run(inputs) - single.run(inputs)).max() < 0.01
