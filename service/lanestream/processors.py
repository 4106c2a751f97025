"""How many processors this process may use: its affinity, and the quota of its control groups."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Final

_ROOT: Final = Path("/")
# Where the controller of processors is mounted: version 2 alone, beside version 1, and version 1 by its usual names.
_VERSION_2: Final = ("sys/fs/cgroup", "sys/fs/cgroup/unified")
_VERSION_1: Final = ("sys/fs/cgroup/cpu", "sys/fs/cgroup/cpu,cpuacct", "sys/fs/cgroup/cpuacct,cpu")

_Read = Callable[[Path], float | None]


def processors() -> int:
    """Threads that can really run at a time, at least 1; a part of a processor counts as one."""
    share = quota()
    return affinity() if share is None else max(1, min(affinity(), math.ceil(share)))


def affinity() -> int:
    """Processors that the scheduler may put this process on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def quota(root: Path = _ROOT) -> float | None:
    """Processors that a container's limit is worth, such as 1.5; None where there is none.

    The limit of an outer control group holds for those in it, hence the least counts. Both versions of control groups
    are read below `root`; files that are missing or not understood are no limit.
    """
    limits = [*_limits(root, "", _VERSION_2, _limit_2), *_limits(root, "cpu", _VERSION_1, _limit_1)]
    return min(limits, default=None)


def _limits(root: Path, controller: str, mounts: tuple[str, ...], read: _Read) -> Iterator[float]:
    group = _group(root, controller)
    # In a container the names may be the host's while its own group is mounted at the top: the top is always read.
    inner = [group, *group.parents] if group.is_absolute() else [PurePosixPath("/")]
    for mount in mounts:
        for each in inner:
            try:
                limit = read(root / mount / each.relative_to("/"))
            except (OSError, ValueError):
                continue
            if limit is not None:
                yield limit


def _group(root: Path, controller: str) -> PurePosixPath:
    """This process's group under `controller`, the one of version 2 where that is empty."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        lines = []
    for line in lines:
        _, _, rest = line.partition(":")
        names, _, group = rest.partition(":")
        if group and controller in names.split(","):
            return PurePosixPath(group)
    return PurePosixPath("/")


def _limit_2(group: Path) -> float | None:
    allowed, period = (group / "cpu.max").read_text().split()
    return None if allowed == "max" else _share(int(allowed), int(period))


def _limit_1(group: Path) -> float | None:
    allowed = int((group / "cpu.cfs_quota_us").read_text())
    return _share(allowed, int((group / "cpu.cfs_period_us").read_text()))


def _share(allowed: int, period: int) -> float | None:
    """Microseconds in every period of as many, as processors; none is no limit."""
    return allowed / period if allowed > 0 and period > 0 else None


def network_threads() -> int:
    """The threads of one network's run that leave room for the frames beside it: half of the processors."""
    return max(1, processors() // 2)
