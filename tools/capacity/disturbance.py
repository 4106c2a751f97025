"""How much of the processors other programs used during a measurement."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

import psutil

# A measurement in which others used more than this share of all processors is not kept.
MOST: Final = 0.08


class DisturbedError(RuntimeError):
    """Other programs used too much of the processors."""


@dataclass
class _Clock:
    """Seconds of processor time: of all processes, of this one and its descendants, and of all processors together."""

    used_s: float
    own_s: float
    all_s: float

    @classmethod
    def read(cls) -> _Clock:
        times = psutil.cpu_times()
        idle_s = times.idle + times.iowait
        all_s = sum(times) - times.guest - times.guest_nice
        return cls(all_s - idle_s, _own_s(), all_s)


def _own_s() -> float:
    """Returns the processor time of this process and its descendants, also of those that have ended."""
    this = psutil.Process()
    own = this.cpu_times()
    total = own.user + own.system + own.children_user + own.children_system
    for child in this.children(recursive=True):
        try:
            times = child.cpu_times()
        except psutil.NoSuchProcess:
            continue
        total += times.user + times.system + times.children_user + times.children_system
    return float(total)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Raises DisturbedError at the end of the block if other programs used too much of the processors meanwhile.

    The processes that the block needs must have been started by this one.
    """
    before = _Clock.read()
    yield
    after = _Clock.read()
    others = (after.used_s - before.used_s) - (after.own_s - before.own_s)
    share = others / (after.all_s - before.all_s)
    if share > MOST:
        raise DisturbedError(
            f"other programs used {share:.0%} of the {os.cpu_count()} processors; more than {MOST:.0%} is too much"
        )
