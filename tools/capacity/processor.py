"""The processor time of a simulated node, which its processes share."""

from __future__ import annotations

import math
from dataclasses import dataclass

import simpy

from capacity.cpu_group import PERIOD_S

# Shorter work than this has been done.
_EPSILON_S = 1e-9


@dataclass(eq=False)
class _Task:
    left_s: float
    done: simpy.Event


class Processor:
    """Runs tasks on `processors`. More tasks than that share them equally.

    With a `limit`, the tasks together get at most so many seconds of processor time per second. As in a control group,
    they run at full speed until their share of a period is used up, and then stop until the next one. `phase_s` is when
    the first period ends.
    """

    def __init__(
        self, env: simpy.Environment, processors: int, limit: float | None = None, phase_s: float = PERIOD_S
    ) -> None:
        self._env = env
        self._processors = processors
        self._quota_s = math.inf if limit is None else limit * PERIOD_S
        self._budget_s = self._quota_s
        self._period_end = math.inf if limit is None else env.now + phase_s
        self._tasks: list[_Task] = []
        self._updated = env.now
        self._version = 0
        self.used_s = 0.0

    def run(self, seconds: float) -> simpy.Event:
        """Adds a task that needs `seconds` of processor time. Returns the event of its end."""
        self._advance()
        task = _Task(seconds, self._env.event())
        self._tasks.append(task)
        self._wake_later()
        return task.done

    @property
    def _speed(self) -> float:
        """The seconds of processor time that each task gets per second."""
        if not self._tasks or self._budget_s <= _EPSILON_S:
            return 0.0
        return min(1.0, self._processors / len(self._tasks))

    def _advance(self) -> None:
        """Brings the tasks up to date."""
        used_s = self._speed * (self._env.now - self._updated)
        for task in self._tasks:
            task.left_s -= used_s
        self.used_s += used_s * len(self._tasks)
        self._budget_s -= used_s * len(self._tasks)
        self._updated = self._env.now
        if self._env.now >= self._period_end - _EPSILON_S:
            self._budget_s = self._quota_s
            self._period_end += PERIOD_S * (1 + (self._env.now - self._period_end + _EPSILON_S) // PERIOD_S)

    def _wake_later(self) -> None:
        """Comes back when a task ends, when the share is used up, or when a new period begins."""
        self._version += 1
        if not self._tasks:
            return
        delay = self._period_end - self._env.now
        speed = self._speed
        if speed > 0.0:
            left_s = min(task.left_s for task in self._tasks)
            delay = min(delay, left_s / speed, self._budget_s / (speed * len(self._tasks)))
        version = self._version
        timeout = self._env.timeout(max(0.0, delay))
        assert timeout.callbacks is not None  # noqa: S101 - it has not happened yet
        timeout.callbacks.append(lambda _: self._woken(version))

    def _woken(self, version: int) -> None:
        if version != self._version:
            return
        self._advance()
        ended = [task for task in self._tasks if task.left_s <= _EPSILON_S]
        self._tasks = [task for task in self._tasks if task.left_s > _EPSILON_S]
        for task in ended:
            task.done.succeed()
        self._wake_later()
