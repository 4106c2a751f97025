"""The commands of `make capacity` without any measurement: their errors, and what they make of results."""

from __future__ import annotations

import errno
import json
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from capacity import measurement
from capacity.__main__ import main
from capacity.calibration import Calibration, ServiceTime
from capacity.cameras import CameraReport
from capacity.comparison import Comparison, compare, summary, table
from capacity.cpu_group import CpuGroup, CpuGroupError
from capacity.load import FrameLife, Load
from capacity.measurement import Case, Measurement, cases, resume_times
from capacity.other_programs import others
from capacity.proxies import PROXIES
from click.testing import CliRunner

TIMES = Calibration((ServiceTime(0.003, 0.02, 0.0, 0.001),), open_s=0.005, save_s=0.0005)
CASE = Case("waiting", 1, Load(2, 10.0))


def run(*arguments: str | Path) -> tuple[int, str]:
    result = CliRunner().invoke(main, [str(each) for each in arguments])
    assert "Traceback" not in result.output
    return result.exit_code, result.output


def measured(case: Case, **figures: float) -> dict[str, Any]:
    usual = {"answered_per_s": 20.0, "p50_ms": 30.0, "p95_ms": 45.0}
    return {"case": case.name, **usual, **figures}


def test_a_calibration_survives_a_file(tmp_path: Path) -> None:
    TIMES.write(tmp_path / "times.json")
    assert Calibration.read(tmp_path / "times.json") == TIMES


def test_the_rest_comes_from_a_node_without_a_limit() -> None:
    free = Calibration(tuple(ServiceTime(0.0, 0.0, 0.0, each) for each in (0.001, 0.002, 0.9)), 0.0, 0.0)
    assert TIMES.with_rest_of(free).frames == (ServiceTime(0.003, 0.02, 0.0, 0.002),)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--fps", "0"], "'0' is not a number above 0, or max"),
        (["--fps", "nan"], "'nan' is not a number above 0, or max"),
        (["--cameras", "0"], "0 is not in the range"),
        (["--limit", "3", "--processors", "2"], "--limit 3 is more than the 2 --processors"),
        (["--lose-at", "1"], "--lose-at needs at least two --nodes"),
        (["--nodes", "2", "--lose-at", "40"], "--lose-at 40 is not within the --seconds 30"),
        (["--calibration", "nowhere.json"], "No such file or directory: 'nowhere.json'"),
        (["--cameras", "1", "--fps", "0.001", "--seconds", "1"], "no frame was answered"),
    ],
)
def test_arguments_that_make_no_sense_have_one_line(arguments: list[str], message: str) -> None:
    code, output = run("simulate", *arguments)
    assert code != 0
    assert message in output.splitlines()[-1]


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"frames": [{"loop_s": 1}], "open_s": 0, "save_s": 0}'])
def test_a_file_that_is_not_a_calibration_is_named(content: str, tmp_path: Path) -> None:
    path = tmp_path / "times.json"
    path.write_text(content)
    code, output = run("simulate", "--calibration", path)
    assert code == 1
    assert f"{path} is not a calibration" in output


def test_a_simulation_prints_its_figures() -> None:
    arguments = ("simulate", "--nodes", "2", "--cameras", "8", "--fps", "10", "--seconds", "5", "--lose-at", "1")
    code, output = run(*arguments)
    assert code == 0
    assert [line.split()[0] for line in output.splitlines()] == [
        "answered",
        "response",
        "queue",
        "utilization",
        "Redis",
        "resumed",
        "reconnecting",
    ]
    code, output = run(*arguments, "--json")
    assert len(json.loads(output)["resumed_s"]) == 4


def test_on_a_device_the_workers_only_wait() -> None:
    _, output = run("simulate", "--cameras", "4", "--fps", "10", "--seconds", "10", "--wait-ms", "5", "--json")
    result = json.loads(output)
    assert result["workers"] == pytest.approx(4 * 10 * 0.005 / 2, rel=0.05)


def test_measure_lists_its_cases() -> None:
    code, output = run("measure", "--list", "--only", "real-3")
    assert code == 0
    assert output.split() == [case.name for case in cases() if case.name.startswith("real-3")]
    code, output = run("measure", "--only", "moon")
    assert code == 2
    assert "no case has 'moon' in its name" in output


def test_a_proxy_that_is_not_installed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("capacity.limits.installed_proxies", list)
    monkeypatch.setattr("capacity.__main__.load_frames", lambda folder: folder)
    name = next(iter(PROXIES))
    code, output = run("limits", name, "--out", tmp_path)
    assert code == 1
    assert f"{name} is not installed (on Debian: apt install {name})" in output


def test_check_without_runs_says_what_makes_them(tmp_path: Path) -> None:
    code, output = run("check", "--out", tmp_path)
    assert code == 1
    assert f"{tmp_path} has no runs; `measure` makes them" in output


def write_runs(folder: Path, *runs: dict[str, Any]) -> None:
    (folder / "runs").mkdir()
    TIMES.write(folder / "calibration-waiting.json")
    for number, content in enumerate(runs):
        (folder / "runs" / f"{number}.json").write_text(json.dumps(content))


def test_check_fails_if_a_figure_is_far_off(tmp_path: Path) -> None:
    write_runs(tmp_path, *(measured(CASE, p50_ms=90.0 + each) for each in range(3)))
    code, output = run("check", "--out", tmp_path, "--json", tmp_path / "check.json")
    assert code == 1
    assert " | 91.0 (90.0 to 92.0); " in output
    assert "frames/s: 1 of 1 within 15%" in output
    assert "p50 ms: 0 of 1 within 15%" in output
    assert json.loads((tmp_path / "check.json").read_text())[1]["measured"] == [90.0, 91.0, 92.0]


def test_check_succeeds_if_all_figures_are_close(tmp_path: Path) -> None:
    p50, p95 = (each.simulated for each in list(compare([CASE], [measured(CASE)], {"waiting": TIMES}))[1:])
    write_runs(tmp_path, measured(CASE, p50_ms=0.9 * p50, p95_ms=1.1 * p95))
    assert run("check", "--out", tmp_path)[0] == 0


def test_the_resumption_after_a_loss_is_compared_too() -> None:
    case = Case("waiting", 2, Load(2, 5.0), loss=True)
    (found,) = compare([case], [{"case": case.name, "resumed_s": [0.1, 0.3]}], {"waiting": TIMES})
    assert found.figure == "resumed ms"
    assert 1.0 < found.simulated < 1000.0


def test_a_table_marks_what_is_far_off() -> None:
    rows = [Comparison("a", "frames/s", (9.0, 10.0, 11.0), 11.4), Comparison("b", "frames/s", (10.0,), 8.0)]
    rows.append(Comparison("b", "p50 ms", (100.0, 120.0, 110.0), 110.4))
    assert list(table(rows)) == [
        "| case | frames/s | p50 ms |",
        "| --- | --- | --- |",
        "| a | 10.0 (9.0 to 11.0); 11.4, +14% |  |",
        "| b | 10.0 (10.0 to 10.0); 8.0, -20% ** | 110 (100 to 120); 110, +0% |",
    ]
    assert list(summary(rows[:2])) == ["frames/s: 1 of 2 within 15%, at most -20% (b)"]


def test_cameras_of_the_lost_node_resume_with_their_next_answer() -> None:
    frames = [FrameLife(0, 1.0, 1.1), FrameLife(1, 1.0, 1.1), FrameLife(0, 2.0, None), FrameLife(0, 2.2, 2.4)]
    assert resume_times(CameraReport(0.0, frames), 2.0, 2) == pytest.approx([0.4])
    with pytest.raises(RuntimeError, match="camera 0 did not resume"):
        resume_times(CameraReport(0.0, frames[:3]), 2.0, 2)


@pytest.mark.parametrize("version", [1, 2])
def test_a_control_group_gets_its_limit(version: int, tmp_path: Path) -> None:
    if version == 1:
        (tmp_path / "cpu").mkdir()
        (tmp_path / "cpu" / "cpu.cfs_quota_us").touch()
    group = CpuGroup("node", tmp_path)
    (folder,) = (tmp_path / "cpu" if version == 1 else tmp_path).glob("lanestream-*-node")
    group.add(4711)
    group.limit(0.4)
    group.take_precedence()
    content = {path.name: path.read_text() for path in folder.iterdir()}
    limit = (
        {"cpu.cfs_period_us": "10000", "cpu.cfs_quota_us": "4000", "cpu.shares": "262144"}
        if version == 1
        else {"cpu.max": "4000 10000", "cpu.weight": "10000"}
    )
    assert content == {"cgroup.procs": "4711", **limit}


def test_a_control_group_that_is_not_allowed_says_so(tmp_path: Path) -> None:
    with pytest.raises(CpuGroupError, match=r"can't make the control group .*; run as root"):
        CpuGroup("node", tmp_path / "missing")


def test_runs_are_kept_and_not_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for engine in ("real", "waiting"):
        TIMES.write(tmp_path / f"calibration-{engine}.json")
    measured: list[tuple[str, int]] = []

    def measure(self: Measurement, case: Case, repeat: int, *_: object) -> dict[str, Any]:
        measured.append((case.name, repeat))
        return {"case": case.name, "resumed_s": [0.1]}

    monkeypatch.setattr(Measurement, "_measure", measure)
    monkeypatch.setattr(measurement, "precedence", nullcontext)
    monkeypatch.setattr(measurement, "load_frames", lambda folder: folder)
    monkeypatch.setattr(measurement, "running_redis", lambda _: nullcontext("redis://"))
    monkeypatch.setattr(measurement, "running_nodes", lambda *_: nullcontext([]))
    measuring = Measurement(tmp_path, 1.0, lambda _: None)
    assert not measuring.run(2, [CASE], until=0.0)
    assert measured == []
    assert measuring.run(1, [CASE], None)
    assert measuring.run(2, [CASE], None)
    assert measured == [(CASE.name, 0), (CASE.name, 1)]
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {f"{CASE.name}-{each}.json" for each in (0, 1)}


def test_measuring_without_root_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "write_text", refuse)
    monkeypatch.setattr(Path, "mkdir", refuse)
    code, output = run("measure", "--out", tmp_path)
    assert code == 1
    assert "-measurement: Permission denied; run as root" in output


def test_what_this_program_uses_is_not_used_by_others() -> None:
    with others() as found:
        end = time.monotonic() + 0.3
        while time.monotonic() < end:
            pass
    assert 0.0 <= found.share < 1.0
