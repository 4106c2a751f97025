"""The benchmark with real contestants, for a moment each: that all of them answer, and what is written."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from bench.__main__ import main, measure
from bench.plan import CONTESTANTS, LARGE, Plan
from bench.table import HEADLINES
from click.testing import CliRunner

PLAN = Plan(
    rounds=1,
    sizes=(LARGE,),
    sessions=(1,),
    seconds=0.2,
    compared_seconds=0.2,
    overload_seconds=0.3,
    overload_clients=(2,),
    soak_minutes=0.01,
)


def marked(value: str) -> list[str]:
    """The commands of all processes that have `value` for TEST_RUN, whoever has become their parent."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            if process.environ().get("TEST_RUN") == value:
                found.append(" ".join(process.cmdline()))
    return found


def test_all_contestants_answer_and_none_is_left_behind(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TEST_RUN", str(tmp_path))
    measure(PLAN, "cpu", None, 3, tmp_path)
    told = json.loads((tmp_path / "bench.json").read_text())
    assert set(HEADLINES) - {"at_64_over_at_4"} <= told.keys()
    assert told["failed"] == 0
    assert {cell["contestant"] for cell in told["cells"] if cell["answers"] > 0} == set(CONTESTANTS)
    assert told["overload"][0]["p50_age_ms"] > 0.0
    assert told["soak"]["failed"] == 0
    assert 0.0 < told["candidates_per_frame"] <= 16.0
    assert told["provider"] == "cpu"
    assert all(cell["memory_mb"] > 10.0 for cell in told["cells"])
    assert "| service |" in capsys.readouterr().out
    # What Python itself keeps for processes that it spawns may stay.
    assert [command for command in marked(str(tmp_path)) if "resource_tracker" not in command] == []


def test_a_clip_that_is_not_there_is_told_in_one_line(tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["--clip", "nowhere.mp4", "--out", str(tmp_path)])
    assert done.exit_code == 1
    assert "no such file or folder: nowhere.mp4" in done.output
    assert "Traceback" not in done.output
