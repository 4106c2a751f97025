"""A short benchmark with the real runners: that all of them reply, and what is written."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from bench.__main__ import main, measure
from bench.report import HEADLINES
from bench.runners import litserve_installed
from bench.workload import LARGE, LITSERVE, RUNNERS, Suite
from click.testing import CliRunner
from processes import commands_of_run

SUITE = Suite(
    rounds=1,
    sizes=(LARGE,),
    sessions=(1,),
    seconds=0.2,
    compared_seconds=0.2,
    overload_seconds=0.3,
    overload_clients=(2,),
    soak_minutes=0.01,
)


def test_all_runners_reply_and_no_process_is_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TEST_RUN", str(tmp_path))
    measure(SUITE, "cpu", None, 3, tmp_path)
    content = json.loads((tmp_path / "bench.json").read_text())
    assert set(HEADLINES) - {"at_64_over_at_4"} <= content.keys()
    assert content["failed"] == 0
    expected = set(RUNNERS) - (set() if litserve_installed() else {LITSERVE})
    assert {row["runner"] for row in content["workloads"] if row["replies"] > 0} == expected
    assert content["overload"][0]["p50_age_ms"] > 0.0
    assert content["soak"]["failed"] == 0
    assert 0.0 < content["candidates_per_frame"] <= 16.0
    assert content["provider"] == "cpu"
    assert all(row["memory_mb"] > 10.0 for row in content["workloads"])
    output = capsys.readouterr().out
    assert "| service |" in output
    assert ("LitServe is not installed" in output) != litserve_installed()
    # Python keeps its own resource tracker for spawned processes.
    assert [command for command in commands_of_run(str(tmp_path)) if "resource_tracker" not in command] == []


def test_a_missing_clip_is_an_error_without_a_traceback(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["--clip", "nowhere.mp4", "--out", str(tmp_path)])
    assert result.exit_code == 1
    assert "no such file or folder: nowhere.mp4" in result.output
    assert "Traceback" not in result.output
