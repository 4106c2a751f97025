"""The image's health check, run as the engine runs it, beside a real server."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

import pytest

SCRIPT = Path(__file__).parents[2] / "docker/healthcheck.py"


def check(**environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-I", SCRIPT], env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0", ""])  # noqa: S104
def test_a_ready_service_is_well_whatever_proxy_there_is_for_the_outside(url: str, host: str) -> None:
    port = str(urlsplit(url).port)
    done = check(LANESTREAM_HOST=host, LANESTREAM_PORT=port, http_proxy="http://127.0.0.1:9")
    assert (done.returncode, done.stderr) == (0, "")


def test_a_service_that_still_loads_is_not_well_and_says_why(serve: Callable[..., str]) -> None:
    done = check(LANESTREAM_PORT=str(urlsplit(serve()).port))
    assert done.returncode == 1
    assert "/readyz: 503" in done.stderr
    assert "not_ready" in done.stderr


def test_where_nobody_listens_nothing_is_well() -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    done = check(LANESTREAM_PORT=str(port))
    assert done.returncode == 1
    assert "refused" in done.stderr
