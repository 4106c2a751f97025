"""Processors and memory limits, from affinity and from control group files as kernels and containers write them."""

import os
from pathlib import Path

import pytest

from lanestream import host


def write_files(root: Path, files: dict[str, str]) -> Path:
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
        pytest.param(
            {"sys/fs/cgroup/cpu.max": "150000 100000\n"}, 1.5, id="version 2, a container's own group at the top"
        ),
        pytest.param(
            {
                "proc/self/cgroup": "0::/system.slice/lanes.service\n",
                "sys/fs/cgroup/system.slice/lanes.service/cpu.max": "max 100000\n",
                "sys/fs/cgroup/system.slice/cpu.max": "400000 100000\n",
            },
            4.0,
            id="version 2, only the outer group has a limit",
        ),
        pytest.param(
            {
                "proc/self/cgroup": "4:memory:/docker/abc\n3:cpu,cpuacct:/docker/abc\n0::/\n",
                "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_quota_us": "50000\n",
                "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_period_us": "100000\n",
            },
            0.5,
            id="version 1, the host's path inside a container",
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
        pytest.param({"sys/fs/cgroup/cpu.max": "many\n"}, None, id="unknown format"),
        pytest.param(
            {"proc/self/cgroup": "what\n", "sys/fs/cgroup/cpu.max": "200000 100000"},
            2.0,
            id="malformed /proc/self/cgroup",
        ),
    ],
)
def test_cpu_quota(tmp_path: Path, files: dict[str, str], expected: float | None) -> None:
    assert host.cpu_quota(write_files(tmp_path, files)) == expected


@pytest.mark.parametrize(("quota", "expected"), [(None, 8), (0.5, 1), (1.5, 2), (3.0, 3), (64.0, 8)])
def test_the_quota_limits_processors_below_the_affinity(
    monkeypatch: pytest.MonkeyPatch, quota: float | None, expected: int
) -> None:
    monkeypatch.setattr(host, "cpu_affinity", lambda: 8)
    monkeypatch.setattr(host, "cpu_quota", lambda: quota)
    assert host.processors() == expected


def test_cpu_affinity_is_the_schedulers_for_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", {0: {2, 5}}.__getitem__, raising=False)
    assert host.cpu_affinity() == 2


def test_all_processors_count_if_the_system_has_no_affinity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert host.cpu_affinity() == 6


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        pytest.param({}, None, id="no control groups"),
        pytest.param({"sys/fs/cgroup/memory.max": "max\n"}, None, id="version 2, no limit"),
        pytest.param({"sys/fs/cgroup/memory.max": "536870912\n"}, 536870912.0, id="version 2, a container"),
        pytest.param(
            {
                "proc/self/cgroup": "0::/pod/lanes\n",
                "sys/fs/cgroup/pod/lanes/memory.max": "max\n",
                "sys/fs/cgroup/pod/memory.max": "1000000000\n",
            },
            1e9,
            id="version 2, only the outer group has a limit",
        ),
        pytest.param(
            {
                "proc/self/cgroup": "4:memory:/docker/abc\n",
                "sys/fs/cgroup/memory/memory.limit_in_bytes": "700000000\n",
            },
            7e8,
            id="version 1, a container",
        ),
        pytest.param(
            {"sys/fs/cgroup/memory/memory.limit_in_bytes": "9223372036854771712\n"}, None, id="version 1, no limit"
        ),
        pytest.param({"sys/fs/cgroup/memory.max": "plenty\n"}, None, id="unknown format"),
    ],
)
def test_memory_limit(tmp_path: Path, files: dict[str, str], expected: float | None) -> None:
    assert host.memory_limit(write_files(tmp_path, files)) == expected


def test_cpu_describes_this_machine() -> None:
    cpu = host.cpu()
    assert cpu.name
    assert 1 <= cpu.used <= cpu.affinity
    assert len(set(cpu.flags)) == len(cpu.flags)
