"""The host's resources: the processors and the memory that this process may use, and the CPU's instruction sets.

In a container the limits are those of its control groups. Both versions of control groups are read.
"""

from __future__ import annotations

import ctypes
import math
import os
import platform
import resource
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final

_ROOT: Final = Path("/")
# Where version 2 of control groups is mounted: on its own, or together with version 1.
_VERSION_2: Final = ("sys/fs/cgroup", "sys/fs/cgroup/unified")
# Where version 1 usually has its CPU and memory controllers.
_CPU_VERSION_1: Final = ("sys/fs/cgroup/cpu", "sys/fs/cgroup/cpu,cpuacct", "sys/fs/cgroup/cpuacct,cpu")
_MEMORY_VERSION_1: Final = ("sys/fs/cgroup/memory",)
# Version 1 writes "no limit" as a number of bytes that no machine has.
_UNLIMITED_BYTES: Final = 1 << 60

# The instruction sets that decide how fast a network runs, on x86 and on ARM.
_RELEVANT_INSTRUCTION_SETS: Final = (
    *("avx2", "avx_vnni", "avx512f", "avx512_vnni", "avx512_bf16", "avx512_fp16", "amx_int8", "amx_bf16"),
    *("asimd", "asimddp", "i8mm", "bf16", "sve"),
)

# glibc's names for the size from which memory is mapped by itself, and for the free memory that it keeps.
_M_MMAP_THRESHOLD: Final = -3
_M_TRIM_THRESHOLD: Final = -1
_LOW_PRIORITY: Final = 10
_KEPT_BYTES: Final = 16 << 20


@dataclass(frozen=True)
class Cpu:
    """The CPU, its relevant instruction sets (`flags`), and how many of its processors this process may use.

    `affinity` is the scheduler's limit, `quota` the container's (None if unlimited), and `used` the result of both.
    """

    name: str
    flags: tuple[str, ...]
    affinity: int
    quota: float | None
    used: int


def cpu() -> Cpu:
    """Returns what is known about the CPU."""
    name = cpu_info().get("model name") or platform.processor() or platform.machine()
    available = instruction_sets()
    flags = tuple(flag for flag in _RELEVANT_INSTRUCTION_SETS if flag in available)
    return Cpu(name, flags, cpu_affinity(), cpu_quota(), processors())


def processors() -> int:
    """Returns how many threads can run at the same time, at least 1; a fraction of a processor counts as one."""
    quota = cpu_quota()
    return cpu_affinity() if quota is None else max(1, min(cpu_affinity(), math.ceil(quota)))


def network_threads() -> int:
    """Returns the threads for one run of a network in a process that also decodes and tracks: half the processors."""
    return max(1, processors() // 2)


def cpu_affinity() -> int:
    """Returns how many processors the scheduler may run this process on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cpu_quota(root: Path = _ROOT) -> float | None:
    """Returns the container's CPU limit in processors, such as 1.5, or None if it has none. Reads files below `root`.

    An outer control group limits the inner ones too, so the smallest limit counts. Files that are missing or have an
    unknown format are ignored.
    """
    limits = [
        *_cgroup_limits(root, "", _VERSION_2, _read_cpu_max),
        *_cgroup_limits(root, "cpu", _CPU_VERSION_1, _read_cfs_quota),
    ]
    return min(limits, default=None)


def memory_limit(root: Path = _ROOT) -> float | None:
    """Returns the container's memory limit in bytes, or None if it has none. Reads files below `root`."""
    limits = [
        *_cgroup_limits(root, "", _VERSION_2, _read_memory_max),
        *_cgroup_limits(root, "memory", _MEMORY_VERSION_1, _read_memory_limit),
    ]
    return min(limits, default=None)


def memory() -> float:
    """Returns the memory that this process may use in bytes: the container's limit, or what the machine has."""
    installed = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    limit = memory_limit()
    return installed if limit is None else min(installed, limit)


def yield_processor() -> None:
    """Lowers the priority of the calling thread. Does nothing on systems where priorities belong to processes."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _LOW_PRIORITY)


def raise_open_files() -> int:
    """Raises the limit of open files to what the system allows, and returns it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        with suppress(ValueError, OSError):  # macOS allows fewer than it says
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def cpu_info(path: Path = Path("/proc/cpuinfo")) -> dict[str, str]:
    """Returns Linux's entries for the first processor, with lowercase names; empty on other systems."""
    try:
        lines = path.read_text().split("\n\n")[0].splitlines()
    except OSError:
        return {}
    pairs = (line.partition(":") for line in lines)
    return {key.strip().lower(): value.strip() for key, _, value in pairs}


def instruction_sets() -> frozenset[str]:
    """Returns the first processor's instruction sets by Linux's names for x86 and ARM; empty on other systems."""
    entries = cpu_info()
    return frozenset((entries.get("flags") or entries.get("features", "")).split())


def _cgroup_limits(
    root: Path, controller: str, mounts: tuple[str, ...], read: Callable[[Path], float | None]
) -> Iterator[float]:
    """Yields the limits of this process's control group under `controller` and of all groups that contain it."""
    group = _cgroup(root, controller)
    # In a container the path may be the host's although the container's own group is mounted at the top. So the top
    # is always read.
    groups = [group, *group.parents] if group.is_absolute() else [PurePosixPath("/")]
    for mount in mounts:
        for each in groups:
            try:
                limit = read(root / mount / each.relative_to("/"))
            except (OSError, ValueError):
                continue
            if limit is not None:
                yield limit


def _cgroup(root: Path, controller: str) -> PurePosixPath:
    """Returns this process's control group under a version 1 `controller`, or in version 2 if that is empty."""
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


def _read_cpu_max(group: Path) -> float | None:
    quota, period = (group / "cpu.max").read_text().split()
    return None if quota == "max" else _processors(int(quota), int(period))


def _read_cfs_quota(group: Path) -> float | None:
    quota = int((group / "cpu.cfs_quota_us").read_text())
    return _processors(quota, int((group / "cpu.cfs_period_us").read_text()))


def _processors(quota_us: int, period_us: int) -> float | None:
    """Returns CPU time per period as a number of processors, or None if it is not limited."""
    return quota_us / period_us if quota_us > 0 and period_us > 0 else None


def _read_memory_max(group: Path) -> float | None:
    limit = (group / "memory.max").read_text().strip()
    return None if limit == "max" else float(int(limit))


def _read_memory_limit(group: Path) -> float | None:
    limit = int((group / "memory.limit_in_bytes").read_text())
    return None if limit >= _UNLIMITED_BYTES else float(limit)


def keep_freed_memory(largest: int = _KEPT_BYTES) -> None:
    """Lets the C library keep up to 16 MB of freed memory, of pieces up to `largest` bytes, for the next allocation.

    Every frame allocates and frees the same few megabytes. By default glibc gives most of it back each time, and the
    page faults of getting it again take longer than some of the work itself. Larger pieces are always given back: by
    default glibc would keep even those once they have been freed. Other C libraries are left as they are.
    """
    mallopt = _c_function("mallopt")
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, largest)
        mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)


def return_freed_memory() -> None:
    """Gives all free memory back to the system, also from between what is in use. Takes a few milliseconds."""
    malloc_trim = _c_function("malloc_trim")
    if malloc_trim is not None:
        malloc_trim(0)


def _c_function(name: str) -> Callable[..., int] | None:
    """Returns a function of glibc; None elsewhere."""
    function: Callable[..., int] | None = getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
    return function
