"""A control group that limits the processor time of a node, so that several nodes fit on one machine."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Final

# The limit holds in each period. In short ones, a node stops and goes so often that it is like a slower processor.
PERIOD_S: Final = 0.01
# The highest weights against other programs.
_SHARES: Final = 262_144
_WEIGHT: Final = 10_000
_ROOT: Final = Path("/sys/fs/cgroup")


class CpuGroupError(RuntimeError):
    """A control group could not be made."""


class CpuGroup:
    """A control group for processes that share `cores` of processor time. Works with versions 1 and 2; needs root."""

    def __init__(self, name: str, root: Path = _ROOT) -> None:
        self._is_v1 = (root / "cpu" / "cpu.cfs_quota_us").exists()
        self._folder = (root / "cpu" if self._is_v1 else root) / f"lanestream-{os.getpid()}-{name}"
        try:
            if not self._is_v1:
                (root / "cgroup.subtree_control").write_text("+cpu")
            self._folder.mkdir()
        except OSError as error:
            raise CpuGroupError(f"can't make the control group {self._folder}: {error.strerror}; run as root") from None

    def add(self, pid: int) -> None:
        """Moves a process, with its later children, into the group."""
        (self._folder / "cgroup.procs").write_text(str(pid))

    def leave(self, pid: int) -> None:
        """Moves a process back to the group above it."""
        (self._folder.parent / "cgroup.procs").write_text(str(pid))

    def take_precedence(self) -> None:
        """Makes other programs wait if the processors do not suffice for all."""
        if self._is_v1:
            (self._folder / "cpu.shares").write_text(str(_SHARES))
        else:
            (self._folder / "cpu.weight").write_text(str(_WEIGHT))

    def limit(self, cores: float) -> None:
        """Limits the processor time of the group per second to `cores` seconds."""
        quota, period = round(1e6 * cores * PERIOD_S), round(1e6 * PERIOD_S)
        if self._is_v1:
            (self._folder / "cpu.cfs_period_us").write_text(str(period))
            (self._folder / "cpu.cfs_quota_us").write_text(str(quota))
        else:
            (self._folder / "cpu.max").write_text(f"{quota} {period}")

    def remove(self) -> None:
        """Removes the group, whose processes have ended."""
        with suppress(OSError):
            self._folder.rmdir()
