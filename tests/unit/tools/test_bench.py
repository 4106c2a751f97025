"""The arithmetic of the benchmark, on made-up replies."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from bench import runners
from bench.frames import forward_and_backward, load_clips
from bench.in_process import PipelineInfo
from bench.load_generator import Load
from bench.measure import Overload, Results, Sample, split_load
from bench.plot import plot, title
from bench.report import HEADLINES, ages_by_second, main, markdown, report
from bench.runners import HelperProcess, server_programs
from bench.workload import (
    BASELINE,
    LARGE,
    LITSERVE,
    LOOP,
    PIPELINE,
    POOL,
    SERVICE,
    SMALL,
    LoadRequest,
    Reply,
    Suite,
)
from click.testing import CliRunner

from lanestream import __version__

INFO = PipelineInfo(processes=2, threads=1, model="fake 1", provider="cpu", patches=12.25)
SUITE = Suite(rounds=3, sizes=(LARGE,), sessions=(1, 4, 64), overload_clients=(4,))

# Frames per second of each runner at up to 4 sessions; at 64 sessions all of them have 0.9 of that.
RATES = {PIPELINE: 40.0, LOOP: 45.0, POOL: 50.0, SERVICE: 48.0, BASELINE: 6.0, LITSERVE: 16.0}


def sample(fps: float, seconds: float = 10.0, ms: float = 20.0, burst: int = 1, sessions: int = 1) -> Sample:
    """Evenly spaced replies, each `ms` after its frame, `burst` of them at the same time."""
    gap = burst * sessions / fps
    replies = [
        Reply(session, end - 1e-3 * ms, end)
        for session in range(sessions)
        for end in (0.3 * gap + gap * n for n in range(int(seconds / gap)))
        for _ in range(burst)
    ]
    return Sample(tuple(replies), 0, seconds, 0.01 * len(replies), 250.0, 0.02, settled=True)


def make_results(slowdown: Callable[[int], float] = lambda _: 1.0, without: frozenset[str] = frozenset()) -> Results:
    """Rounds on a machine that is slower by a factor of the round, and overloads with frames three times as old."""
    results = Results()
    for number in range(SUITE.rounds):
        speed = slowdown(number)
        results.rounds.append(
            {
                each: sample(speed * RATES[each.runner] * (0.9 if each.sessions == 64 else 1.0), ms=20.0 / speed)
                for each in SUITE.round(number)
                if each.runner not in without
            }
        )
        results.overloads.append([Overload(4, 36.0, sample(45.0, ms=60.0 / speed))])
    results.soak = Overload(4, 36.0, sample(45.0))
    return results


def test_ratios_are_of_the_same_round() -> None:
    content = report(make_results(lambda number: (1.0, 0.25, 0.5)[number]), SUITE, INFO, "no frames")
    assert content["service_over_inprocess"] == pytest.approx(48.0 / 50.0)  # the pool is the fastest in-process runner
    assert content["at_64_over_at_4"] == pytest.approx(0.9)
    assert content["over_baseline"] == pytest.approx(8.0)
    assert content["over_litserve"] == pytest.approx(3.0)
    assert content["overload_p95_age_over_median"] == pytest.approx(3.0)
    assert content["ratios"]["1280x720"]["over_baseline"] == {
        key: pytest.approx(8.0, abs=1e-3) for key in ("median", "min", "max")
    }
    # Over all replies, most of which are from the fastest round.
    assert (content["median_ms_720p_classifier"], content["median_ms_720p_regressor"]) == (20.0, 20.0)


def test_a_queue_that_never_stops_growing_has_no_times_and_no_ratio() -> None:
    results = make_results()
    for samples in results.rounds:
        samples.update({key: replace(each, settled=False) for key, each in samples.items() if key.sessions == 64})
    content = report(results, SUITE, INFO, "no frames")
    assert content["at_64_over_at_4"] is None
    assert {row["p50_ms"] for row in content["workloads"] if row["sessions"] == 64} == {None}
    assert "| - | - |" in "\n".join(markdown(content))


@pytest.mark.parametrize("burst", [1, 2, 8])
@pytest.mark.parametrize("sessions", [1, 4, 64])
def test_bursts_of_replies_do_not_change_the_rate(burst: int, sessions: int) -> None:
    assert sample(40.0, seconds=2.7 * burst * sessions / 40.0, burst=burst, sessions=sessions).fps == pytest.approx(
        40.0
    )


def test_too_few_replies_are_counted() -> None:
    pairs = tuple(Reply(session, 0.0, session + end) for session in range(3) for end in (0.0, 0.1))
    assert Sample(pairs, 0, 3.0, 0.0, 1.0, 0.0, settled=False).fps == pytest.approx(2.0)
    assert sample(1.0, seconds=1.0).fps == pytest.approx(1.0)
    assert Sample((), 0, 2.0, 0.0, 1.0, 0.0, settled=False).fps == 0.0


def test_the_soak_shows_that_frames_get_older() -> None:
    results = make_results()
    ages = [Reply(0, second + 0.5 - 1e-3 * (20.0 + second), second + 0.5) for second in range(60)]
    assert results.soak is not None
    results.soak = replace(results.soak, sample=replace(results.soak.sample, replies=tuple(ages)))
    soak = report(results, SUITE, INFO, "no frames")["soak"]
    assert soak["slope_ms_per_minute"] == pytest.approx(60.0)
    assert soak["last_fifth"]["p50_ms"] - soak["first_fifth"]["p50_ms"] == pytest.approx(48.0)
    assert [round(age) for (age,) in ages_by_second(results.soak.sample)][:3] == [20, 21, 22]


def test_all_runners_get_the_loads_of_few_sessions_in_every_round() -> None:
    for number in range(5):
        for size in (LARGE, SMALL):
            pairs = {(each.runner, each.sessions) for each in Suite().round(number) if each.size == size}
            assert {(name, count) for name in RATES for count in (1, 4)} <= pairs
            assert {(name, count) for name in (PIPELINE, SERVICE) for count in (16, 64)} <= pairs


def test_sessions_are_divided_among_the_generators() -> None:
    helpers: list[HelperProcess] = [object(), object()]  # type: ignore[list-item]
    for sessions in (1, 4, 5):
        parts = split_load(LoadRequest(SMALL, sessions), helpers)
        assert sum(part.sessions for _, part in parts) == sessions
        assert len(parts) == min(2, sessions)


def test_the_drive_alternates_direction() -> None:
    assert [forward_and_backward(number, 3) for number in range(6)] == [0, 1, 2, 1, 0, 1]
    assert [forward_and_backward(number, 1) for number in range(3)] == [0, 0, 0]


def test_frames_of_a_folder_are_cut_to_size(tmp_path: Path) -> None:
    frame = load_clips([(320, 240)], 1)[320, 240][0]
    (tmp_path / "one.jpg").write_bytes(frame)
    clips = load_clips([(320, 180), (160, 90)], 4, str(tmp_path))
    assert {size: len(jpegs) for size, jpegs in clips.items()} == {(320, 180): 1, (160, 90): 1}


def test_errors_are_counted_and_are_not_lanes() -> None:
    load = Load(LoadRequest(SMALL, 1), [b""])
    replies = ['{"type":"error","code":"x","seq":1}', '{"type": "lanes", "seq": 2}', "what"]
    assert [load._message_type(reply) for reply in replies] == ["error", "lanes", ""]
    assert load.result.failed == 1


def test_the_tables_and_the_figure_are_made_from_the_json(tmp_path: Path) -> None:
    content = json.loads(json.dumps(report(make_results(), SUITE, INFO, "no frames")))
    lines = list(markdown(content))
    assert sum(any(text in line for text in HEADLINES.values()) for line in lines) == len(HEADLINES)
    assert sum(line.startswith("| service") for line in lines) == 5  # three throughputs and two latencies
    plot(content, tmp_path / "bench.png")
    assert (tmp_path / "bench.png").read_bytes().startswith(b"\x89PNG")
    assert f"Lanestream {__version__}," in title(content)
    assert f"({content['machine']['processor']})" in title(content)


def test_a_file_that_is_not_a_report_is_an_error_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "bench.json").write_text("{}")
    result = CliRunner().invoke(main, [str(tmp_path / "bench.json")])
    assert result.exit_code == 1
    assert result.output.count("\n") == 1
    assert "was not written by `make bench`" in result.output


def test_litserve_is_left_out_if_it_is_not_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runners, "litserve_installed", lambda: True)
    assert [program.name for program in server_programs("cpu")] == [SERVICE, BASELINE, LITSERVE]
    monkeypatch.setattr(runners, "litserve_installed", lambda: False)
    assert [program.name for program in server_programs("cpu")] == [SERVICE, BASELINE]
    content = report(make_results(without=frozenset({LITSERVE})), SUITE, INFO, "no frames")
    assert content["over_litserve"] is None
    assert content["over_baseline"] == pytest.approx(8.0)
    assert "| throughput over LitServe, 4 sessions | - | - to - |" in list(markdown(content))
    plot(content, tmp_path / "bench.png")
