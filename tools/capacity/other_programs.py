"""Other programs on the machine during a measurement: they get less of the processors, and their share is reported."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import psutil

from capacity.cpu_group import CpuGroup


@contextmanager
def precedence() -> Iterator[None]:
    """Gives this process, and those that it starts in the block, precedence over others. Raises CpuGroupError."""
    group = CpuGroup("measurement")
    group.take_precedence()
    group.add(os.getpid())
    try:
        yield
    finally:
        group.leave(os.getpid())
        group.remove()


@dataclass
class Others:
    """The share of all processors that other programs used, known at the end of `others`."""

    share: float = 0.0


@contextmanager
def others() -> Iterator[Others]:
    """Measures the block, whose processes must be descendants of this one."""
    found = Others()
    before, own = psutil.cpu_times(), _own_s()
    yield found
    after, own = psutil.cpu_times(), _own_s() - own
    idle_s = after.idle + after.iowait - before.idle - before.iowait
    all_s = sum(after) - after.guest - after.guest_nice - (sum(before) - before.guest - before.guest_nice)
    found.share = max(0.0, all_s - idle_s - own) / all_s if all_s else 0.0


def _own_s() -> float:
    """Returns the processor time of this process and its descendants, also of those that have ended."""
    this = psutil.Process()
    total = 0.0
    for process in (this, *this.children(recursive=True)):
        try:
            times = process.cpu_times()
        except psutil.NoSuchProcess:
            continue
        total += times.user + times.system + times.children_user + times.children_system
    return total
