"""Processors by affinity and by the quotas of control groups, from files as kernels and containers lay them out."""

import os
from pathlib import Path

import pytest

from lanestream import processors as module
from lanestream.processors import affinity, processors, quota


def written(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        pytest.param({}, None, id="no control groups"),
        pytest.param({"sys/fs/cgroup/cpu.max": "max 100000\n"}, None, id="version 2, no limit"),
        pytest.param({"sys/fs/cgroup/cpu.max": "150000 100000\n"}, 1.5, id="version 2, a container's own group on top"),
        pytest.param(
            {
                "proc/self/cgroup": "0::/system.slice/lanes.service\n",
                "sys/fs/cgroup/system.slice/lanes.service/cpu.max": "max 100000\n",
                "sys/fs/cgroup/system.slice/cpu.max": "400000 100000\n",
            },
            4.0,
            id="version 2, the outer group is limited",
        ),
        pytest.param(
            {
                "proc/self/cgroup": "4:memory:/docker/abc\n3:cpu,cpuacct:/docker/abc\n0::/\n",
                "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_quota_us": "50000\n",
                "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_period_us": "100000\n",
            },
            0.5,
            id="version 1, the host's names inside a container",
        ),
        pytest.param(
            {
                "proc/self/cgroup": "1:cpu:/\n",
                "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "-1\n",
                "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000\n",
            },
            None,
            id="version 1, no limit",
        ),
        pytest.param({"sys/fs/cgroup/cpu.max": "many\n"}, None, id="not understood"),
        pytest.param({"proc/self/cgroup": "what\n", "sys/fs/cgroup/cpu.max": "200000 100000"}, 2.0, id="odd names"),
    ],
)
def test_a_quota_is_read(tmp_path: Path, files: dict[str, str], expected: float | None) -> None:
    assert quota(written(tmp_path, files)) == expected


@pytest.mark.parametrize(("share", "expected"), [(None, 8), (0.5, 1), (1.5, 2), (3.0, 3), (64.0, 8)])
def test_a_quota_counts_below_the_affinity(monkeypatch: pytest.MonkeyPatch, share: float | None, expected: int) -> None:
    monkeypatch.setattr(module, "affinity", lambda: 8)
    monkeypatch.setattr(module, "quota", lambda: share)
    assert processors() == expected


def test_affinity_is_the_schedulers_for_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", {0: {2, 5}}.__getitem__, raising=False)
    assert affinity() == 2


def test_without_a_schedulers_affinity_all_processors_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert affinity() == 6
