"""A container's limit of memory, from files as kernels and containers lay them out."""

from __future__ import annotations

from pathlib import Path

import pytest

from lanestream.memory import memory_limit


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
            id="version 2, the outer group is limited",
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
        pytest.param({"sys/fs/cgroup/memory.max": "plenty\n"}, None, id="not understood"),
    ],
)
def test_a_limit_is_read(tmp_path: Path, files: dict[str, str], expected: float | None) -> None:
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    assert memory_limit(tmp_path) == expected
