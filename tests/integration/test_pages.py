"""The files of the pages for browsers over real sockets: who gets them, and with which headers."""

from __future__ import annotations

import os
import re
import signal
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urljoin

import fakes
import httpx
import pytest

from lanestream.keys import new_key

Serve = Callable[..., str]


@pytest.fixture
def guarded(serve: Serve) -> str:
    """Returns the URL of a service that requires a key."""
    return serve(fakes.engine(), api_keys=str(new_key("camera-7")[1]))


@pytest.mark.parametrize("path", ["/", "/static/index.html"])
def test_the_page_needs_no_key_and_may_only_use_its_own_scripts(guarded: str, path: str) -> None:
    response = httpx.get(guarded + path)
    assert response.status_code == 200
    assert response.headers["content-type"].startswith("text/html")
    policy = response.headers["content-security-policy"]
    assert "default-src 'self'" in policy
    assert "unsafe" not in policy
    assert response.headers["x-content-type-options"] == "nosniff"
    assert response.headers["referrer-policy"] == "no-referrer"
    assert response.headers["cache-control"] == "no-cache"


def test_the_documentation_of_the_api_needs_nothing_from_elsewhere(guarded: str) -> None:
    page = httpx.get(f"{guarded}/docs")
    assert page.status_code == 200
    assert "default-src 'self'" in page.headers["content-security-policy"]
    links = re.findall(r'(?:href|src)="([^"]*)"', page.text)
    assert len(links) >= 3
    for link in links:
        assert httpx.get(urljoin(str(page.url), link)).status_code == 200
    assert not re.findall(r"https?://", page.text)
    assert httpx.get(urljoin(str(page.url), re.findall(r"url: '([^']*)'", page.text)[0])).json()["openapi"]


@pytest.mark.parametrize("path", ["/static/", "/static/../app.py", "/static/%2e%2e/app.py", "/static//etc/passwd"])
def test_nothing_else_is_served(url: str, path: str) -> None:
    request = httpx.Request("GET", url)
    request.url = request.url.copy_with(raw_path=path.encode())
    with httpx.Client() as client:
        response = client.send(request)
    assert (response.status_code, response.json()["code"]) == (404, "not_found")


def test_the_page_can_be_switched_off(serve: Serve) -> None:
    url = serve(fakes.engine(), live_page=False)
    assert [httpx.get(url + path).status_code for path in ("/", "/static/index.html")] == [404, 404]


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0", "::1"])  # noqa: S104
def test_serve_opens_the_page_once_the_service_is_ready(tmp_path: Path, host: str) -> None:
    browser = tmp_path / "browser"
    browser.write_text(
        f'#!{sys.executable}\nimport sys, httpx\nprint("opened", sys.argv[1], httpx.get(sys.argv[1]), flush=True)\n'
    )
    browser.chmod(browser.stat().st_mode | stat.S_IXUSR)
    command = [sys.executable, "-m", "lanestream.cli", "serve", "--open", "--port", "0", "--host", host]
    environment = {**os.environ, "BROWSER": str(browser), "LANESTREAM_API_KEYS": str(new_key("camera-7")[1])}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        line = process.stdout.readline().decode()
        process.send_signal(signal.SIGINT)
        process.wait(fakes.WAIT_S)
    reachable = "[::1]" if host == "::1" else "127.0.0.1"
    assert line.startswith(f"opened http://{reachable}:")
    assert "200 OK" in line
