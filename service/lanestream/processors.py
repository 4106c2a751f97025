"""The processors: how many this process may use, by its affinity and its control groups, and what they can do."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Final

from lanestream.cgroups import ROOT, VERSION_2, limits

# Where version 1 has the controller of processors, by its usual names.
_VERSION_1: Final = ("sys/fs/cgroup/cpu", "sys/fs/cgroup/cpu,cpuacct", "sys/fs/cgroup/cpuacct,cpu")


def processors() -> int:
    """Threads that can really run at a time, at least 1; a part of a processor counts as one."""
    share = quota()
    return affinity() if share is None else max(1, min(affinity(), math.ceil(share)))


def affinity() -> int:
    """Processors that the scheduler may put this process on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def quota(root: Path = ROOT) -> float | None:
    """Processors that a container's limit is worth, such as 1.5; None where there is none.

    The limit of an outer control group holds for those in it, hence the least counts. Both versions of control groups
    are read below `root`; files that are missing or not understood are no limit.
    """
    found = [*limits(root, "", VERSION_2, _limit_2), *limits(root, "cpu", _VERSION_1, _limit_1)]
    return min(found, default=None)


def _limit_2(group: Path) -> float | None:
    allowed, period = (group / "cpu.max").read_text().split()
    return None if allowed == "max" else _share(int(allowed), int(period))


def _limit_1(group: Path) -> float | None:
    allowed = int((group / "cpu.cfs_quota_us").read_text())
    return _share(allowed, int((group / "cpu.cfs_period_us").read_text()))


def _share(allowed: int, period: int) -> float | None:
    """Microseconds in every period of as many, as processors; none is no limit."""
    return allowed / period if allowed > 0 and period > 0 else None


def cpu_entries(path: Path = Path("/proc/cpuinfo")) -> dict[str, str]:
    """What the system tells of its first processor, the entries' names in small letters; nothing outside Linux."""
    try:
        lines = path.read_text().split("\n\n")[0].splitlines()
    except OSError:
        return {}
    pairs = (line.partition(":") for line in lines)
    return {key.strip().lower(): value.strip() for key, _, value in pairs}


def instructions() -> frozenset[str]:
    """The first processor's instruction sets by Linux's names, x86's and ARM's; nothing outside Linux."""
    told = cpu_entries()
    return frozenset((told.get("flags") or told.get("features", "")).split())


def network_threads() -> int:
    """The threads of one network's run that leave room for the frames beside it: half of the processors."""
    return max(1, processors() // 2)
