"""How much memory the processes of this service may have: the limit of its control groups."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from lanestream.cgroups import ROOT, VERSION_2, limits

_VERSION_1: Final = ("sys/fs/cgroup/memory",)
# By more than any machine has, version 1 says that there is no limit.
_NO_LIMIT: Final = 1 << 60


def memory_limit(root: Path = ROOT) -> float | None:
    """Bytes that a container's limit allows; None where there is none. Files are read below `root`."""
    found = [*limits(root, "", VERSION_2, _limit_2), *limits(root, "memory", _VERSION_1, _limit_1)]
    return min(found, default=None)


def _limit_2(group: Path) -> float | None:
    allowed = (group / "memory.max").read_text().strip()
    return None if allowed == "max" else float(int(allowed))


def _limit_1(group: Path) -> float | None:
    allowed = int((group / "memory.limit_in_bytes").read_text())
    return None if allowed >= _NO_LIMIT else float(allowed)
