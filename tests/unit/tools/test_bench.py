"""The benchmark's arithmetic, on answers that were made up."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from bench.figures import by_second, figures
from bench.frames import load_clips, to_and_fro
from bench.inprocess import Hello
from bench.load import Load
from bench.measuring import Sample, shared_out
from bench.orders import Answer, Helper, Order
from bench.plan import LARGE, LITSERVE, LOOP, NAIVE, PIPELINE, POOL, SERVICE, SMALL, Plan
from bench.plot import plot
from bench.running import Overload, Results
from bench.table import HEADLINES, markdown
from click.testing import CliRunner

HELLO = Hello(processes=2, threads=1, model="fake 1", provider="cpu", patches=12.25)
PLAN = Plan(rounds=3, sizes=(LARGE,), sessions=(1, 4, 64), overload_clients=(4,))

# Frames a second of each contestant at 4 sessions; the service has 0.9 of that at 64.
RATES = {PIPELINE: 40.0, LOOP: 45.0, POOL: 50.0, SERVICE: 48.0, NAIVE: 6.0, LITSERVE: 16.0}


def sample(fps: float, seconds: float = 10.0, ms: float = 20.0, burst: int = 1, sessions: int = 1) -> Sample:
    """Evenly spaced answers of so many sessions, each some milliseconds after its frame, some at the same time."""
    gap = burst * sessions / fps
    answers = [
        Answer(session, end - 1e-3 * ms, end)
        for session in range(sessions)
        for end in (0.3 * gap + gap * n for n in range(int(seconds / gap)))
        for _ in range(burst)
    ]
    return Sample(tuple(answers), 0, seconds, 0.01 * len(answers), 250.0, 0.02, settled=True)


def results(slowed: Callable[[int], float] = lambda _: 1.0) -> Results:
    """Rounds in which the whole machine is slower by a factor, and overloads with frames three times as old."""
    told = Results()
    for number in range(PLAN.rounds):
        speed = slowed(number)
        told.cells.append(
            {
                cell: sample(speed * RATES[cell.contestant] * (0.9 if cell.sessions == 64 else 1.0), ms=20.0 / speed)
                for cell in PLAN.round(number)
            }
        )
        told.overloads.append([Overload(4, 36.0, sample(45.0, ms=60.0 / speed))])
    told.soak = Overload(4, 36.0, sample(45.0))
    return told


def test_ratios_are_of_the_same_round() -> None:
    told = figures(results(lambda number: (1.0, 0.25, 0.5)[number]), PLAN, HELLO, "no frames")
    assert told["service_over_inprocess"] == pytest.approx(48.0 / 50.0)  # the pool, which is the fastest of the three
    assert told["at_64_over_at_4"] == pytest.approx(0.9)
    assert told["over_naive"] == pytest.approx(8.0)
    assert told["over_litserve"] == pytest.approx(3.0)
    assert told["overload_p95_age_over_median"] == pytest.approx(3.0)
    assert told["ratios"]["1280x720"]["over_naive"] == {
        key: pytest.approx(8.0, abs=1e-3) for key in ("median", "least", "most")
    }
    # Of all answers, most of which the fastest round gave.
    assert (told["median_ms_720p_classifier"], told["median_ms_720p_regressor"]) == (20.0, 20.0)


def test_a_queue_that_never_stopped_growing_has_no_times_and_no_ratio() -> None:
    made = results()
    for cells in made.cells:
        cells.update({cell: replace(each, settled=False) for cell, each in cells.items() if cell.sessions == 64})
    told = figures(made, PLAN, HELLO, "no frames")
    assert told["at_64_over_at_4"] is None
    assert {cell["p50_ms"] for cell in told["cells"] if cell["sessions"] == 64} == {None}
    assert "| - | - |" in "\n".join(markdown(told))


@pytest.mark.parametrize("burst", [1, 2, 8])
@pytest.mark.parametrize("sessions", [1, 4, 64])
def test_bursts_of_answers_do_not_change_a_rate(burst: int, sessions: int) -> None:
    assert sample(40.0, seconds=2.7 * burst * sessions / 40.0, burst=burst, sessions=sessions).fps == pytest.approx(
        40.0
    )


def test_a_rate_of_too_few_answers_is_a_count() -> None:
    pairs = tuple(Answer(session, 0.0, session + end) for session in range(3) for end in (0.0, 0.1))
    assert Sample(pairs, 0, 3.0, 0.0, 1.0, 0.0, settled=False).fps == pytest.approx(2.0)
    assert sample(1.0, seconds=1.0).fps == pytest.approx(1.0)
    assert Sample((), 0, 2.0, 0.0, 1.0, 0.0, settled=False).fps == 0.0


def test_soaked_frames_that_get_older_are_seen() -> None:
    made = results()
    ages = [Answer(0, second + 0.5 - 1e-3 * (20.0 + second), second + 0.5) for second in range(60)]
    assert made.soak is not None
    made.soak = replace(made.soak, sample=replace(made.soak.sample, answers=tuple(ages)))
    soak = figures(made, PLAN, HELLO, "no frames")["soak"]
    assert soak["slope_ms_per_minute"] == pytest.approx(60.0)
    assert soak["last_fifth"]["p50_ms"] - soak["first_fifth"]["p50_ms"] == pytest.approx(48.0)
    assert [round(age) for (age,) in by_second(made.soak.sample)][:3] == [20, 21, 22]


def test_every_load_meets_all_contestants_in_every_round_where_there_are_few_sessions() -> None:
    for number in range(5):
        for size in (LARGE, SMALL):
            met = {(cell.contestant, cell.sessions) for cell in Plan().round(number) if cell.size == size}
            assert {(name, count) for name in RATES for count in (1, 4)} <= met
            assert {(name, count) for name in (PIPELINE, SERVICE) for count in (16, 64)} <= met


def test_sessions_are_shared_out_and_none_is_lost() -> None:
    helpers: list[Helper] = [object(), object()]  # type: ignore[list-item]
    for sessions in (1, 4, 5):
        shares = shared_out(Order(SMALL, sessions), helpers)
        assert sum(order.sessions for _, order in shares) == sessions
        assert len(shares) == min(2, sessions)


def test_the_drive_goes_to_and_fro() -> None:
    assert [to_and_fro(number, 3) for number in range(6)] == [0, 1, 2, 1, 0, 1]
    assert [to_and_fro(number, 1) for number in range(3)] == [0, 0, 0]


def test_frames_of_a_folder_are_cut_to_size(tmp_path: Path) -> None:
    frame = load_clips([(320, 240)], 1)[320, 240][0]
    (tmp_path / "one.jpg").write_bytes(frame)
    clips = load_clips([(320, 180), (160, 90)], 4, str(tmp_path))
    assert {size: len(jpegs) for size, jpegs in clips.items()} == {(320, 180): 1, (160, 90): 1}


def test_errors_are_counted_and_are_no_lanes() -> None:
    load = Load(Order(SMALL, 1), [b""])
    replies = ['{"type":"error","code":"x","seq":1}', '{"type": "lanes", "seq": 2}', "what"]
    assert [load._kind(reply) for reply in replies] == ["error", "lanes", ""]
    assert load.tally.failed == 1


def test_the_tables_and_the_picture_are_made_of_what_was_written(tmp_path: Path) -> None:
    told = json.loads(json.dumps(figures(results(), PLAN, HELLO, "no frames")))
    lines = list(markdown(told))
    assert sum(any(text in line for text in HEADLINES.values()) for line in lines) == len(HEADLINES)
    assert sum(line.startswith("| service") for line in lines) == 5  # 1, 4 and 64 sessions, and two alone
    plot(told, tmp_path / "bench.png")
    assert (tmp_path / "bench.png").read_bytes().startswith(b"\x89PNG")


def test_what_is_no_result_is_refused_in_one_line(tmp_path: Path) -> None:
    from bench.table import main

    (tmp_path / "bench.json").write_text("{}")
    done = CliRunner().invoke(main, [str(tmp_path / "bench.json")])
    assert done.exit_code == 1
    assert done.output.count("\n") == 1
    assert "is not what `make bench` writes" in done.output
