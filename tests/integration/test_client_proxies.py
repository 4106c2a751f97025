"""Clients that reach a service through a proxy, or fail to."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

import fakes
import pytest
from proxyserver import http_proxy, proxy_server, refusing_proxy, socks_proxy
from scripted import refused_url

from lanestream.errors import ConnectionFailedError
from lanestream_client import AsyncLaneClient, LaneClient

Handler = Callable[[socket.socket, list[str]], None]


def port_of(url: str) -> int:
    return urlsplit(url).port or 80


@pytest.fixture(autouse=True)
def no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.lower().endswith("_proxy")]:
        monkeypatch.delenv(name)


@pytest.mark.parametrize(
    ("scheme", "serve", "asked"),
    [
        ("http", http_proxy, ["http://lanes.test:80/v1/detect", "lanes.test:80"]),
        ("socks", socks_proxy, ["lanes.test", "lanes.test"]),
        ("socks5h", socks_proxy, ["lanes.test", "lanes.test"]),
    ],
)
async def test_requests_and_streams_go_through_the_proxy(
    url: str, scheme: str, serve: Callable[[int], Handler], asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with proxy_server(serve(port_of(url))) as (port, seen):
        monkeypatch.setenv("ALL_PROXY", f"{scheme}://127.0.0.1:{port}")
        with LaneClient("http://lanes.test") as client:
            assert len(client.detect(fakes.image_file()).lanes) == 2
            assert [result.error for result in client.stream([fakes.image_file()])] == [None]
        async with AsyncLaneClient("http://lanes.test") as other:
            assert len((await other.detect(fakes.image_file())).lanes) == 2
            assert [result.error async for result in other.stream([fakes.image_file()])] == [None]
    assert [target.replace("test/", "test:80/") for target in seen] == 2 * asked


def test_a_local_service_is_reached_directly(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ALL_PROXY", "HTTP_PROXY", "http_proxy"):
        monkeypatch.setenv(name, f"socks://{refused_url().removeprefix('http://')}")
    with LaneClient(url) as client:
        assert len(client.detect(fakes.image_file()).lanes) == 2
        assert [result.error for result in client.stream([fakes.image_file()])] == [None]


@pytest.mark.parametrize("scheme", ["http", "socks"])
def test_a_proxy_that_is_down_is_blamed(scheme: str, monkeypatch: pytest.MonkeyPatch) -> None:
    proxy = refused_url().removeprefix("http://")
    monkeypatch.setenv("HTTP_PROXY", f"{scheme}://me:secret@{proxy}")
    shown = f"{scheme.replace('socks', 'socks5h')}://{proxy}"
    with LaneClient("http://lanes.test", reconnect_s=0.0) as client:
        for attempt in (client.describe, lambda: list(client.stream([fakes.image_file()]))):
            with pytest.raises(ConnectionFailedError) as caught:
                attempt()
            assert caught.value.message.startswith(
                f"can't reach the service at http://lanes.test through the proxy {shown} of HTTP_PROXY: "
            )
            assert "add lanes.test to NO_PROXY" in caught.value.hint
            assert "secret" not in str(caught.value)
            assert "\n" not in str(caught.value)


@pytest.mark.parametrize("status", ["403 Forbidden", "407 Proxy Authentication Required", "502 Bad Gateway"])
def test_a_proxy_that_refuses_is_blamed(status: str, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = f"HTTP/1.1 {status}\r\ncontent-length: 2\r\nconnection: close\r\n\r\nno".encode()
    with proxy_server(refusing_proxy(answer)) as (port, _):
        monkeypatch.setenv("HTTP_PROXY", f"http://127.0.0.1:{port}")
        with LaneClient("http://lanes.test", reconnect_s=0.0) as client:
            for attempt in (client.describe, lambda: list(client.stream([fakes.image_file()]))):
                with pytest.raises(ConnectionFailedError) as caught:
                    attempt()
                assert status[:3] in caught.value.message
                assert f"through the proxy http://127.0.0.1:{port} of HTTP_PROXY" in caught.value.message
                assert "add lanes.test to NO_PROXY" in caught.value.hint


@pytest.mark.parametrize("value", ["socks://127.0.0.1:9", "socks4://p"])
def test_the_command_line_works_with_a_local_service(url: str, value: str, tmp_path: Path) -> None:
    (tmp_path / "road.jpg").write_bytes(fakes.image_file())
    command = [sys.executable, "-m", "lanestream.cli", "detect", "road.jpg", "--url"]
    environment = {**os.environ, "ALL_PROXY": value, "all_proxy": value}
    for target, code in ((url, 0), ("http://lanes.test", 1)):
        done = subprocess.run(
            [*command, target], cwd=tmp_path, capture_output=True, text=True, env=environment, timeout=60
        )
        assert (done.returncode, "Traceback" in done.stderr) == (code, False), done.stderr
        assert len(done.stderr.splitlines()) == code
