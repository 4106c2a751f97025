"""The control groups that this process is in, of both versions, as kernels and containers lay them out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Final

ROOT: Final = Path("/")
# Where version 2 is mounted: alone, or beside version 1.
VERSION_2: Final = ("sys/fs/cgroup", "sys/fs/cgroup/unified")

Read = Callable[[Path], float | None]


def limits(root: Path, controller: str, mounts: tuple[str, ...], read: Read) -> Iterator[float]:
    """What `read` finds in the folders of this process's group under `controller` and of the groups around it.

    The limit of an outer group holds for those in it. Files that are missing or not understood are no limit.
    """
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
