"""The configurations of reverse proxies in docs/deployment.md, run by those proxies in front of a service."""

from __future__ import annotations

import os
import re
import shutil
import socket
import ssl
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import docpages
import fakes
import httpx
import pytest
import trustme

from lanestream.settings import Settings
from lanestream_client import LaneClient

Serve = Callable[..., str]
# What the proxies of the documentation allow.
MAX_BYTES = Settings().max_bytes


@dataclass(frozen=True)
class Proxy:
    """A proxy that runs: its URL and the file of the authority that its certificate is from."""

    url: str
    ca_file: Path

    @property
    def tls(self) -> ssl.SSLContext:
        """A context that trusts the authority."""
        return ssl.create_default_context(cafile=self.ca_file)


def documented(language: str) -> str:
    """Returns the page's only block in a language."""
    (found,) = [block.text for block in docpages.blocks("docs/deployment.md") if block.language == language]
    return found


def replaced(text: str, replacements: dict[str, str]) -> str:
    """Replaces what must differ in a test. Each key must be there."""
    for old, new in replacements.items():
        assert old in text, old
        text = text.replace(old, new)
    return text


def nginx(service: str, port: int, certificate: Path, folder: Path) -> list[str]:
    text = replaced(
        documented("nginx"),
        {
            "listen 443 ssl": f"listen 127.0.0.1:{port} ssl",
            "lanes.example.com;": "localhost;",
            "/etc/ssl/lanes.example.com.pem": str(certificate),
            "/etc/ssl/lanes.example.com.key": str(certificate),
            "127.0.0.1:8000": service,
        },
    )
    paths = "".join(f"{kind}_temp_path {folder};" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi"))
    user = "user root;" if os.geteuid() == 0 else ""
    main = f"{user} pid {folder}/pid; error_log stderr; events {{}} http {{ access_log off; {paths}\n{text} }}"
    (folder / "nginx.conf").write_text(main)
    return ["nginx", "-c", str(folder / "nginx.conf"), "-g", "daemon off;"]


def haproxy(service: str, port: int, certificate: Path, folder: Path) -> list[str]:
    text = replaced(
        documented("haproxy"),
        {
            "bind :443": f"bind 127.0.0.1:{port}",
            "/etc/ssl/lanes.example.com.both.pem": str(certificate),
            "127.0.0.1:8000": service,
            "127.0.0.1:8001": "127.0.0.1:1",
        },
    )
    (folder / "haproxy.cfg").write_text(text)
    return ["haproxy", "-db", "-f", str(folder / "haproxy.cfg")]


def caddy(service: str, port: int, certificate: Path, folder: Path) -> list[str]:
    site = f"https://localhost:{port} {{\n    tls {certificate} {certificate}"
    text = replaced(documented("caddyfile"), {"lanes.example.com {": site, "127.0.0.1:8000": service})
    (folder / "Caddyfile").write_text("{\n    admin off\n    auto_https disable_redirects\n}\n" + text)
    return ["caddy", "run", "--config", str(folder / "Caddyfile"), "--adapter", "caddyfile"]


PROXIES = [nginx, haproxy, caddy]


def check_installed(name: str) -> None:
    """Fails if a proxy is not installed, except Caddy, which Debian only has in an older version."""
    if shutil.which(name) is None:
        if name == "caddy":
            pytest.skip("caddy 2.7 or later is not installed")
        pytest.fail(f"{name} is not installed (on Debian: apt install {name})")


@contextmanager
def running(command: list[str], port: int, log: Path) -> Iterator[None]:
    """Runs a proxy and waits until it accepts connections."""
    with log.open("w") as file, subprocess.Popen(command, stdout=file, stderr=file) as process:
        try:
            end = time.monotonic() + fakes.WAIT_S
            while True:
                with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
                    break
                assert process.poll() is None, log.read_text()
                assert time.monotonic() < end, log.read_text()
                time.sleep(0.02)
            yield
        finally:
            process.terminate()


@pytest.fixture(params=PROXIES, ids=lambda proxy: proxy.__name__)
def proxy(request: pytest.FixtureRequest, serve: Serve, tmp_path: Path) -> Iterator[Proxy]:
    check_installed(request.param.__name__)
    authority = trustme.CA()
    authority.cert_pem.write_to_path(str(tmp_path / "ca.pem"))
    certificate = tmp_path / "certificate.pem"
    authority.issue_cert("localhost").private_key_and_cert_chain_pem.write_to_path(str(certificate))
    with socket.create_server(("127.0.0.1", 0)) as free:
        port: int = free.getsockname()[1]
    service = serve(fakes.engine(), metrics_access="open").removeprefix("http://")
    command = request.param(service, port, certificate, tmp_path)
    with running(command, port, tmp_path / "log"):
        yield Proxy(f"https://localhost:{port}", tmp_path / "ca.pem")


def test_a_stream_and_an_image_pass(proxy: Proxy) -> None:
    with LaneClient(proxy.url, ca_file=proxy.ca_file) as client:
        assert client.detect(fakes.image_file()).lanes is not None
        answers = list(client.stream([fakes.image_file()] * 20, mode="all"))
    assert [answer.lanes is not None for answer in answers] == [True] * 20


def test_an_image_of_the_largest_size_passes_as_a_body_and_as_a_form(proxy: Proxy) -> None:
    image = fakes.image_file()
    largest = image + bytes(MAX_BYTES - len(image))
    with httpx.Client(base_url=proxy.url, verify=proxy.tls, timeout=60.0) as client:
        body = client.post("/v1/detect", content=largest, headers={"Content-Type": "image/jpeg"})
        form = client.post("/v1/detect", files={"file": ("road.jpg", largest, "image/jpeg")})
        assert (body.status_code, form.status_code) == (200, 200), (body.text, form.text)
        assert client.post("/v1/detect", content=largest + bytes(1)).status_code == 413


def test_the_metrics_stay_inside(proxy: Proxy) -> None:
    with httpx.Client(base_url=proxy.url, verify=proxy.tls) as client:
        for path in ("/metrics", "/%6detrics", "/metrics?a=b"):
            assert client.get(path).status_code == 404
        assert client.get("/readyz").status_code == 200


def test_the_limit_of_nginx_is_that_of_forms() -> None:
    (size,) = re.findall(r"client_max_body_size (\d+)k;", documented("nginx"))
    assert int(size) * 1024 == MAX_BYTES + (1 << 16)
