"""Runs attacks one after the other, each against a service that it starts."""

from __future__ import annotations

import asyncio
import resource
import time
from collections.abc import Coroutine, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from attack.definition import Attack, UnexpectedError
from attack.observer import observer
from attack.report import Memory, Outcome, failures, felt, memory_is_back
from attack.target import Target, running_target

# An attack that has not ended by itself so long after its time is cancelled.
_GRACE_S: Final = 30.0
_POLL_S: Final = 0.25


@dataclass(frozen=True)
class Pace:
    """How long attacks take: in their `short` form or not, and how long to wait at most until memory is back."""

    short: bool
    rest_s: float


class Runner:
    """Runs attacks. The normal cameras show `jpegs`; logs go to the folder `logs`."""

    def __init__(self, jpegs: Sequence[bytes], logs: Path, pace: Pace) -> None:
        self._jpegs = jpegs
        self._logs = logs
        self._pace = pace
        self._alone: float | None = None

    def run(self, attack: Attack) -> Outcome:
        """Starts a service, attacks it and returns the outcome."""
        with ExitStack() as stack:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="attack-")))
            environment = stack.enter_context(attack.surroundings(folder))
            log = self._logs / f"attack-{attack.name.replace('/', '-')}.log"
            service = running_target(log, attack.settings, environment, unread_log=attack.unread_log)
            return self.attack(attack, stack.enter_context(service))

    def attack(self, attack: Attack, target: Target) -> Outcome:
        """Attacks a running service and returns the outcome."""
        target = replace(target, payload=asyncio.run(attack.prepare(target)))
        alone = self._answers_alone(attack, target) if attack.fair else None
        logged = target.log.stat().st_size
        with observer(target, self._jpegs, attack.cameras) as watching:
            before = target.memory_mb()
            began = time.monotonic()
            unexpected = self._attack(attack, target, began)
            ended = time.monotonic()
            after = self._rest(target, before)
            observation = watching.finish()
        most = max(mb for when, mb in observation.memory if when >= began - _POLL_S)
        ended = min(ended, observation.ended or ended)
        camera = felt(observation.frames, began, ended)
        outcome = Outcome(
            attack=attack.name,
            description=attack.description,
            camera=camera,
            newcomer=felt(observation.newcomers, began, ended),
            health=felt(observation.health, began, ended),
            memory=Memory(round(before, 1), round(most, 1), round(after, 1)),
            share=None if alone is None else round(camera.answered / (ended - began) / alone, 3),
            late_ms=round(1e3 * observation.late_s, 1),
            refusals=dict(observation.refusals),
        )
        traceback = b"Traceback" in target.log.read_bytes()[logged:]
        found = failures(attack, outcome, observation, unexpected, traceback=traceback)
        return replace(outcome, failures=tuple(found))

    def _attack(self, attack: Attack, target: Target, began: float) -> str | None:
        """Attacks, and returns what the attack did not expect, None if nothing."""
        seconds = attack.short_seconds if self._pace.short else attack.seconds
        count = attack.short_count if self._pace.short else attack.count
        try:
            asyncio.run(_within(seconds + _GRACE_S, attack.run(target, began + seconds, count)))
        except UnexpectedError as error:
            return str(error)
        except TimeoutError:
            return f"the attack did not end within {_GRACE_S:g} s of its time"
        except OSError as error:
            return f"the attack was broken off: {error!r}"
        return None

    def _rest(self, target: Target, before: float) -> float:
        """Waits until the memory is back, or for the rest, and returns the memory in MB."""
        end = time.monotonic() + self._pace.rest_s
        while True:
            after = target.memory_mb()
            if memory_is_back(before, after) or time.monotonic() >= end:
                return after
            time.sleep(_POLL_S)

    def _answers_alone(self, attack: Attack, target: Target) -> float:
        """Returns how many answers per second the cameras get without an attack; measures it the first time."""
        if self._alone is None:
            with observer(target, self._jpegs, attack.cameras) as watching:
                began = time.monotonic()
                time.sleep(attack.short_seconds if self._pace.short else attack.seconds)
                ended = time.monotonic()
                frames = felt(watching.finish().frames, began, ended)
            self._alone = frames.answered / (ended - began)
        return self._alone


def raise_file_limit() -> None:
    """Allows this process as many open files as the system permits."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


async def _within(seconds: float, attack: Coroutine[Any, Any, None]) -> None:
    async with asyncio.timeout(seconds):
        await attack
