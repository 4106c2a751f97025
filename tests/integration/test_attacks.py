"""A short form of `make attack`: normal cameras are served while a real service is attacked, and it stops in time."""

from __future__ import annotations

import os
import resource
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from attack.__main__ import main
from attack.catalog import ATTACKS, select
from attack.definition import Attack, UnexpectedError
from attack.observer import Beat
from attack.report import felt, table
from attack.runner import Pace, Runner, raise_file_limit
from attack.target import Target, running_target
from bench.frames import load_clips
from bench.workload import LARGE
from click.testing import CliRunner

SETTINGS = {"handshake_s": 2, "body_s": 2, "idle_s": 4}


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runner]:
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    raise_file_limit()
    yield Runner(load_clips((LARGE,), 4)[LARGE], tmp_path_factory.mktemp("logs"), Pace(short=True, rest_s=10.0))
    resource.setrlimit(resource.RLIMIT_NOFILE, limits)


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Target]:
    with running_target(tmp_path_factory.mktemp("service") / "log", SETTINGS, {}) as target:
        yield target


def short(name: str, seconds: float) -> Attack:
    """Returns the attack with this name in its short form, which takes so long."""
    (attack,) = select([name])
    return replace(attack, short_seconds=seconds)


@pytest.mark.parametrize(
    ("name", "seconds"),
    [
        ("heads/lines", 1.5),
        ("heads/upgrade-cookie", 1.5),
        ("connections/bodies", 4.0),
        ("never_read/pings", 1.5),
        ("never_read/pictures", 3.0),
        ("not_frames/text-14mb", 1.5),
        ("not_frames/texts-small-8", 1.5),
        ("not_frames/fragments-empty", 1.5),
        ("memory/bodies", 1.5),
        ("costly/frames-50", 1.5),
    ],
)
def test_normal_cameras_are_served_during_an_attack(name: str, seconds: float, runner: Runner, target: Target) -> None:
    assert runner.attack(short(name, seconds), target).failures == ()


@pytest.mark.parametrize("name", ["stops/never_read", "logs/unread"])
def test_a_service_under_attack_stops_in_time(name: str, runner: Runner) -> None:
    assert runner.run(short(name, 2.0)).failures == ()


def test_an_outage_of_the_service_is_noticed(runner: Runner, target: Target) -> None:
    async def stop(target: Target, stop_at: float, _: int) -> None:
        os.kill(target.pid, signal.SIGSTOP)
        time.sleep(stop_at - time.monotonic())
        os.kill(target.pid, signal.SIGCONT)

    outcome = runner.attack(Attack("test/outage", "the service stands still", stop, short_seconds=2.5), target)
    assert outcome.camera.answered < outcome.camera.sent
    assert outcome.camera.worst_ms > 2000.0
    assert [failure.partition(" for ")[0] for failure in outcome.failures] == [
        "a normal camera waited",
        "new cameras were locked out",
        "/healthz was locked out",
    ]
    assert "**fails**: a normal camera waited" in list(table([outcome]))[-1]


def test_what_the_attack_did_not_expect_is_reported(runner: Runner, target: Target) -> None:
    async def attack(target: Target, stop_at: float, count: int) -> None:
        raise UnexpectedError(f"{count} connections were kept")

    outcome = runner.attack(Attack("test/unexpected", "nothing", attack, short_count=7), target)
    assert outcome.failures == ("7 connections were kept",)


def test_frames_count_from_when_they_were_due_until_any_later_answer() -> None:
    beats = [Beat(0.0, 0.05, True), Beat(1.0, 3.0, False), Beat(1.2, 2.8, True), Beat(5.0, 0.1, True)]
    during = felt(beats, 0.5, 4.5)
    assert (during.sent, during.answered, during.p95_ms, during.worst_ms) == (2, 1, 3000.0, 3000.0)


def test_attacks_are_selected_by_name_or_kind(tmp_path: Path) -> None:
    assert len({attack.name for attack in ATTACKS}) == len(ATTACKS)
    assert {attack.name for attack in select(["clock", "heads/url"])} == {"clock/steps", "heads/url"}
    result = CliRunner().invoke(main, ["--only", "nothing", "--json", str(tmp_path / "report.json")])
    assert result.exit_code == 2
    assert "'nothing' is not an attack" in result.output
    listing = CliRunner().invoke(main, ["--list"]).output
    assert all(f"{attack.name} " in listing for attack in ATTACKS)
