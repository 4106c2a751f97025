"""Clients of a service over TLS, with a private authority and certificates of clients, on real sockets."""

from __future__ import annotations

import asyncio
import ssl
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import fakes
import pytest
import trustme
import uvicorn
from servers import serving

from lanestream.api import create_app
from lanestream.api.server import listen
from lanestream.errors import ConnectionFailedError, SettingsError
from lanestream.settings import Settings
from lanestream_client import AsyncLaneClient, LaneClient


@contextmanager
def serving_tls(authority: trustme.CA, name: str) -> Iterator[str]:
    """Runs a service with a certificate for `name`, and yields its URL."""
    with tempfile.TemporaryDirectory() as folder:
        certificate = Path(folder) / "certificate.pem"
        authority.issue_cert(name).private_key_and_cert_chain_pem.write_to_path(str(certificate))
        with serving(fakes.engine(), Settings(tls_certificate=certificate)) as url:
            yield url


@contextmanager
def asking_for_certificates(authority: trustme.CA, clients: trustme.CA) -> Iterator[str]:
    """Runs a service whose clients need a certificate, as a proxy may demand it, and yields its URL."""
    listener = listen("127.0.0.1", 0)
    config = uvicorn.Config(create_app(fakes.engine(), Settings()), log_config=None)
    config.load()
    config.ssl = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert("127.0.0.1").configure_cert(config.ssl)
    clients.configure_trust(config.ssl)
    config.ssl.verify_mode = ssl.CERT_REQUIRED
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        deadline = time.monotonic() + fakes.WAIT_S
        while not server.started:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        yield f"https://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join(fakes.WAIT_S)
        assert not thread.is_alive()


@pytest.fixture(scope="module")
def authority() -> trustme.CA:
    return trustme.CA()


@pytest.fixture(scope="module")
def url(authority: trustme.CA) -> Iterator[str]:
    with serving_tls(authority, "127.0.0.1") as url:
        yield url


@pytest.fixture(scope="module")
def ca_file(authority: trustme.CA, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tls") / "ca.pem"
    authority.cert_pem.write_to_path(str(path))
    return path


def test_requests_and_streams_trust_a_private_authority(url: str, ca_file: Path) -> None:
    with LaneClient(url, ca_file=ca_file) as client:
        assert client.detect(fakes.image_file()).width > 0
        (result,) = client.stream([fakes.image_file()], mode="all")
    assert result.lanes is not None


def test_the_async_client_does_too(url: str, ca_file: Path) -> None:
    async def use() -> int:
        async with AsyncLaneClient(url, ca_file=ca_file) as client:
            await client.detect(fakes.image_file())
            return len([result async for result in client.stream([fakes.image_file()], mode="all") if result.lanes])

    assert asyncio.run(use()) == 1


def failure(url: str, **options: Path) -> ConnectionFailedError:
    """Returns the error of a request, which a stream must have, too."""
    with LaneClient(url, reconnect_s=0.0, **options) as client:
        with pytest.raises(ConnectionFailedError) as request:
            client.detect(fakes.image_file())
        with pytest.raises(ConnectionFailedError) as stream:
            list(client.stream([fakes.image_file()]))
    assert stream.value.hint == request.value.hint
    return request.value


def test_an_unknown_authority_is_named_as_the_reason(url: str, tmp_path: Path) -> None:
    assert "--ca-file" in failure(url).hint
    trustme.CA().cert_pem.write_to_path(str(tmp_path / "other.pem"))
    assert "--ca-file" in failure(url, ca_file=tmp_path / "other.pem").hint


def test_a_certificate_of_another_host_is_named_as_the_reason(authority: trustme.CA, ca_file: Path) -> None:
    with serving_tls(authority, "lanes.test") as url:
        assert failure(url, ca_file=ca_file).hint == "use a host name or address that is in the service's certificate"


def test_https_to_a_port_without_tls_is_named_as_the_reason() -> None:
    with serving(fakes.engine(), Settings()) as url:
        assert "http:// instead of https://" in failure(url.replace("http", "https")).hint


def test_a_service_may_ask_for_a_certificate(authority: trustme.CA, ca_file: Path, tmp_path: Path) -> None:
    clients = trustme.CA()
    certificate = tmp_path / "camera.pem"
    clients.issue_cert("camera-7").private_key_and_cert_chain_pem.write_to_path(str(certificate))
    with asking_for_certificates(authority, clients) as url:
        with LaneClient(url, ca_file=ca_file, client_certificate=certificate) as client:
            assert client.detect(fakes.image_file()).width > 0
            assert len(list(client.stream([fakes.image_file()], mode="all"))) == 1
        assert "--client-certificate" in failure(url, ca_file=ca_file).hint


def test_files_that_cannot_be_used_are_one_line(tmp_path: Path, ca_file: Path) -> None:
    (tmp_path / "bad.pem").write_text("no certificate")
    for name in ("missing.pem", "bad.pem"):
        with pytest.raises(SettingsError, match=f"can't use the CA file .*{name}: ") as caught:
            LaneClient("https://127.0.0.1:1", ca_file=tmp_path / name)
        assert "\n" not in str(caught.value)
        with pytest.raises(SettingsError, match=f"can't use the client certificate .*{name}: "):
            LaneClient("https://127.0.0.1:1", client_certificate=tmp_path / name)
    with pytest.raises(SettingsError, match="does not use TLS"):
        LaneClient("http://127.0.0.1:1", ca_file=ca_file)


def test_the_commands_have_the_options(url: str, ca_file: Path, tmp_path: Path) -> None:
    (tmp_path / "road.jpg").write_bytes(fakes.image_file())
    command = [sys.executable, "-m", "lanestream", "detect", str(tmp_path / "road.jpg"), "--url", url]
    for options, code in (["--ca-file", str(ca_file)], 0), ([], 1):
        result = subprocess.run([*command, *options], capture_output=True, text=True, check=False, timeout=60)
        assert result.returncode == code, result.stderr
        assert ("--ca-file" in result.stderr) == (code == 1)
