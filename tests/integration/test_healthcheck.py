"""The image's health check, run as the container engine runs it, against a real server."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

import fakes
import pytest
import trustme

SCRIPT = Path(__file__).parents[2] / "docker/healthcheck.py"


def check(**environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-I", SCRIPT], env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0", ""])  # noqa: S104
def test_a_ready_service_is_healthy_and_no_proxy_is_used(url: str, host: str) -> None:
    port = str(urlsplit(url).port)
    result = check(LANESTREAM_HOST=host, LANESTREAM_PORT=port, http_proxy="http://127.0.0.1:9")
    assert (result.returncode, result.stderr) == (0, "")


def test_a_service_with_a_certificate_is_asked_over_https(serve: Callable[..., str], tmp_path: Path) -> None:
    certificate = tmp_path / "certificate.pem"
    trustme.CA().issue_cert("lanes.example.com").private_key_and_cert_chain_pem.write_to_path(str(certificate))
    url = serve(fakes.engine(), tls_certificate=certificate)
    result = check(LANESTREAM_PORT=str(urlsplit(url).port), LANESTREAM_TLS_CERTIFICATE=str(certificate))
    assert (result.returncode, result.stderr) == (0, "")


def test_a_loading_service_is_not_healthy_and_the_reason_is_reported(serve: Callable[..., str]) -> None:
    result = check(LANESTREAM_PORT=str(urlsplit(serve()).port))
    assert result.returncode == 1
    assert "/readyz: 503" in result.stderr
    assert "not_ready" in result.stderr


def test_without_a_service_the_check_fails() -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    result = check(LANESTREAM_PORT=str(port))
    assert result.returncode == 1
    assert "refused" in result.stderr
