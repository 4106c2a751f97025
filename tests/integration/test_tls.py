"""The service's own TLS on real sockets: its certificate, and peers that don't keep to the protocol."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import ssl
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import fakes
import httpx
import processes
import pytest
import rawclient
import trustme
import uvloop
from servers import serving
from websockets.exceptions import ConnectionClosedError
from websockets.sync.client import connect as connect_stream

from lanestream.errors import LanestreamError, SettingsError
from lanestream.settings import Settings, load_settings
from lanestream_client import LaneClient

Serve = Callable[..., str]


class Files(NamedTuple):
    """The files of a certificate for 127.0.0.1, and that of its authority."""

    certificate: Path
    key: Path
    ca: Path


def write_files(folder: Path, authority: trustme.CA, name: str = "127.0.0.1", **dates: datetime) -> Files:
    files = Files(folder / "certificate.pem", folder / "key.pem", folder / "ca.pem")
    issued = authority.issue_cert(name, **dates)
    files.certificate.write_bytes(b"".join(blob.bytes() for blob in issued.cert_chain_pems))
    files.key.write_bytes(issued.private_key_pem.bytes())
    files.ca.write_bytes(authority.cert_pem.bytes())
    return files


@pytest.fixture(scope="module")
def authority() -> trustme.CA:
    return trustme.CA()


@pytest.fixture(scope="module")
def files(authority: trustme.CA, tmp_path_factory: pytest.TempPathFactory) -> Files:
    return write_files(tmp_path_factory.mktemp("tls"), authority)


@pytest.fixture(scope="module")
def trusted(authority: trustme.CA) -> ssl.SSLContext:
    context = ssl.create_default_context()
    authority.configure_trust(context)
    return context


@pytest.fixture(scope="module")
def url(files: Files) -> Iterator[str]:
    with serving(fakes.engine(), Settings(tls_certificate=files.certificate, tls_key=files.key)) as url:
        yield url


@pytest.fixture
def secure(serve: Serve, files: Files) -> Serve:
    """Returns a function that starts a server with a certificate, and returns its URL."""
    return lambda engine=None, **settings: serve(
        engine, tls_certificate=files.certificate, tls_key=files.key, **settings
    )


@contextmanager
def connect(url: str, context: ssl.SSLContext) -> Iterator[ssl.SSLSocket]:
    """Connects to the service, and ends the handshake."""
    with rawclient.connect(url) as plain, context.wrap_socket(plain, server_hostname="127.0.0.1") as connection:
        yield connection


def cut(url: str, context: ssl.SSLContext, reason: str) -> float:
    """Returns how many connections were cut for a reason."""
    name = f'lane_connections_cut_total{{reason="{reason}"}} '
    lines = httpx.get(f"{url}/metrics", verify=context).text.splitlines()
    (value,) = [line.removeprefix(name) for line in lines if line.startswith(name)]
    return float(value)


def wait_until_cut(url: str, context: ssl.SSLContext, reason: str, count: float = 1.0) -> None:
    deadline = time.monotonic() + fakes.WAIT_S
    while cut(url, context, reason) < count:
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize("loop", [asyncio.new_event_loop, uvloop.new_event_loop])
def test_requests_and_streams_use_it(files: Files, loop: Callable[[], asyncio.AbstractEventLoop]) -> None:
    settings = Settings(tls_certificate=files.certificate, tls_key=files.key)
    with serving(fakes.engine(), settings, loop) as url, LaneClient(url, ca_file=files.ca) as client:
        assert client.detect(fakes.image_file()).width > 0
        picture = httpx.post(
            f"{url}/v1/detect",
            content=fakes.image_file(".png", 1920, 1080),
            headers={"content-type": "image/png", "accept": "image/png"},
            verify=ssl.create_default_context(cafile=files.ca),
        )
        assert len(picture.content) > 1 << 14
        assert len(list(client.stream([fakes.image_file()] * 20, mode="all"))) == 20


def test_one_file_may_contain_certificate_and_key(files: Files, serve: Serve, tmp_path: Path) -> None:
    both = tmp_path / "both.pem"
    both.write_bytes(files.key.read_bytes() + files.certificate.read_bytes())
    with LaneClient(serve(fakes.engine(), tls_certificate=both), ca_file=files.ca) as client:
        assert client.detect(fakes.image_file()).width > 0


def test_old_versions_of_tls_are_refused(url: str, trusted: ssl.SSLContext) -> None:
    old = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    old.check_hostname, old.verify_mode = False, ssl.CERT_NONE
    old.set_ciphers("ALL:@SECLEVEL=0")
    with pytest.warns(DeprecationWarning, match="TLSv1"):
        old.minimum_version, old.maximum_version = ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1
    with pytest.raises(ssl.SSLError, match="PROTOCOL_VERSION"), connect(url, old):
        pass
    with connect(url, trusted) as connection:
        assert connection.version() == "TLSv1.3"


def test_tls_1_2_is_accepted(url: str, authority: trustme.CA) -> None:
    context = ssl.create_default_context()
    authority.configure_trust(context)
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    with httpx.Client(verify=context) as client:
        assert client.get(f"{url}/healthz").status_code == 200
        assert client.get(f"{url}/readyz").status_code == 200


def test_a_request_without_tls_is_answered_with_the_reason(url: str) -> None:
    plain = url.replace("https", "http")
    answer = httpx.get(f"{plain}/healthz")
    assert answer.status_code == 400
    assert "https://" in answer.json()["hint"]
    with LaneClient(plain, reconnect_s=0.0) as client:
        with pytest.raises(LanestreamError, match="this port uses TLS") as request:
            client.detect(fakes.image_file())
        with pytest.raises(LanestreamError, match="this port uses TLS"):
            list(client.stream([fakes.image_file()]))
    assert "https://" in request.value.hint


def test_a_handshake_must_end_in_time(secure: Serve, trusted: ssl.SSLContext) -> None:
    url = secure(fakes.engine(), handshake_s=0.5)
    with rawclient.connect(url) as silent, rawclient.connect(url) as slow:
        incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        with pytest.raises(ssl.SSLWantReadError):
            trusted.wrap_bio(incoming, outgoing, server_hostname="127.0.0.1").do_handshake()
        hello = outgoing.read()
        with suppress(ConnectionError):
            for byte in hello[:100]:
                slow.sendall(bytes([byte]))
                time.sleep(0.02)
        assert rawclient.read_all(silent) == rawclient.read_all(slow) == b""
    wait_until_cut(url, trusted, "tls", 2.0)


def test_connections_before_the_handshake_are_limited(secure: Serve, trusted: ssl.SSLContext) -> None:
    url = secure(fakes.engine(), max_connections=10, max_connections_per_address=5, handshake_s=30.0)
    with ExitStack() as stack:
        silent = [stack.enter_context(rawclient.connect(url)) for _ in range(20)]
        wait_until_cut(url, trusted, "address_limit", 15.0)
        assert all(map(rawclient.is_closed, silent[:15]))
        assert httpx.get(f"{url}/healthz", verify=trusted).status_code == 200


def test_handshakes_of_one_address_take_turns(secure: Serve, trusted: ssl.SSLContext) -> None:
    url = secure(fakes.engine())
    with ExitStack() as stack:
        # Each of them asks for a handshake; more than begin at once.
        context = ssl.create_default_context()
        for _ in range(600):
            outgoing = ssl.MemoryBIO()
            with pytest.raises(ssl.SSLWantReadError):
                context.wrap_bio(ssl.MemoryBIO(), outgoing, server_hostname="127.0.0.1").do_handshake()
            stack.enter_context(rawclient.connect(url)).sendall(outgoing.read())
        assert httpx.get(f"{url}/healthz", verify=trusted).status_code == 200


@pytest.mark.parametrize(
    "data",
    [b"\x16\x03\x01\x00\x05hello", b"\x16\x03\x01\xff\xff" + bytes(1 << 17), b"\x00" * 5, b"\xff", b"SSH-2.0-x\r\n"],
)
def test_what_is_not_tls_is_cut(secure: Serve, trusted: ssl.SSLContext, data: bytes) -> None:
    url = secure(fakes.engine(), handshake_s=0.5)
    with rawclient.connect(url) as connection:
        connection.sendall(data)
        rawclient.read_all(connection)
    assert httpx.get(f"{url}/healthz", verify=trusted).status_code == 200


def test_a_record_that_was_changed_is_cut(url: str, trusted: ssl.SSLContext) -> None:
    before = cut(url, trusted, "tls")
    with rawclient.connect(url) as plain:
        descriptor = trusted.wrap_socket(plain, server_hostname="127.0.0.1").detach()
        with socket.socket(fileno=descriptor) as raw:
            raw.settimeout(fakes.WAIT_S)
            raw.sendall(b"\x17\x03\x03\x00\x20" + bytes(32))
            rawclient.read_all(raw)
    wait_until_cut(url, trusted, "tls", before + 1.0)


def test_a_peer_that_only_changes_keys_is_cut(url: str, trusted: ssl.SSLContext) -> None:
    before = cut(url, trusted, "tls")
    command = ["openssl", "s_client", "-quiet", "-no_ign_eof", "-connect", url.removeprefix("https://")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT) as peer:
        assert peer.stdin is not None
        deadline = time.monotonic() + fakes.WAIT_S
        with suppress(BrokenPipeError):
            while peer.poll() is None:
                assert time.monotonic() < deadline
                # A line that begins with K makes it change the keys of both sides.
                os.write(peer.stdin.fileno(), b"K\n")
                time.sleep(0.0002)
        with suppress(BrokenPipeError):
            peer.stdin.close()
    wait_until_cut(url, trusted, "tls", before + 1.0)


def test_a_head_that_is_too_large_is_answered(url: str, trusted: ssl.SSLContext) -> None:
    with connect(url, trusted) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n" + b"X-More: 1\r\n" * 1000)
        assert rawclient.read_all(connection).startswith(b"HTTP/1.1 431 ")


def test_pieces_of_records_make_a_request(url: str, trusted: ssl.SSLContext) -> None:
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    peer = trusted.wrap_bio(incoming, outgoing, server_hostname="127.0.0.1")
    with rawclient.connect(url) as connection:
        while True:
            try:
                peer.do_handshake()
                break
            except ssl.SSLWantReadError:
                connection.sendall(outgoing.read())
                incoming.write(connection.recv(1 << 16))
        # The last flight of the handshake and a request, in one packet, then in single bytes.
        peer.write(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
        connection.sendall(outgoing.read())
        peer.write(b"GET /healthz HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
        for byte in outgoing.read():
            connection.sendall(bytes([byte]))
        incoming.write(rawclient.read_all(connection))
        text = b""
        while part := peer.read(1 << 16):
            text += part
        assert text.count(b"HTTP/1.1 200 OK") == 2


def test_answers_that_are_never_read_end_the_connection(secure: Serve, trusted: ssl.SSLContext) -> None:
    url = secure(fakes.engine(), send_s=0.5)
    with rawclient.connect(url, read_buffer=4096) as plain:
        connection = trusted.wrap_socket(plain, server_hostname="127.0.0.1")
        with suppress(OSError):
            for _ in range(200):
                connection.sendall(b"GET /openapi.json HTTP/1.1\r\nHost: x\r\n\r\n")
        wait_until_cut(url, trusted, "send")
        connection.close()


def test_a_drain_ends_streams_in_order(files: Files) -> None:
    settings = {"tls_certificate": files.certificate, "tls_key": files.key, "processes": 0}
    context = ssl.create_default_context(cafile=files.ca)
    with (
        processes.service(**settings) as (process, url),
        connect_stream(f"{url.replace('http', 'ws')}/v1/stream", ssl=context) as stream,
        rawclient.connect(url) as other,
    ):
        assert process.stderr is not None
        other.sendall(b"\x16\x03\x01\x00\x05hello")
        assert any("closed a connection from 127.0.0.1: TLS failed: " in line for line in process.stderr)
        stream.send(json.dumps({"type": "start", "mode": "all"}))
        assert json.loads(stream.recv(fakes.WAIT_S))["type"] == "ready"
        stream.send(fakes.image_file())
        process.send_signal(signal.SIGTERM)
        kinds = {json.loads(stream.recv(fakes.WAIT_S))["type"] for _ in range(2)}
        assert kinds == {"draining", "lanes"}
        with pytest.raises(ConnectionClosedError, match="1012"):
            stream.recv(fakes.WAIT_S)
        assert process.wait(fakes.WAIT_S) == -signal.SIGTERM


def _serial(url: str, context: ssl.SSLContext) -> int:
    with connect(url, context) as connection:
        certificate = connection.getpeercert()
        assert certificate is not None
        return int(str(certificate["serialNumber"]), 16)


def test_a_renewed_certificate_is_used_without_a_restart(authority: trustme.CA, tmp_path: Path) -> None:
    files = write_files(tmp_path, authority)
    context = ssl.create_default_context(cafile=files.ca)
    with processes.service(tls_certificate=files.certificate, tls_key=files.key, processes=0) as (process, url):
        assert process.stderr is not None
        with connect_stream(f"{url.replace('http', 'ws')}/v1/stream", ssl=context) as stream:
            stream.send(json.dumps({"type": "start", "mode": "all"}))
            stream.recv(fakes.WAIT_S)
            first = _serial(url, context)
            # One file after the other, as a renewal writes them.
            renewed = write_files(tmp_path, authority)
            for line in process.stderr:
                if "the certificate has changed" in line:
                    break
            assert _serial(url, context) != first
            stream.send(fakes.image_file())
            assert json.loads(stream.recv(fakes.WAIT_S))["type"] == "lanes"

        now = _serial(url, context)
        renewed.key.write_text("no key")
        for line in process.stderr:
            if "ERROR" in line:
                break
        assert "the certificate stays as it was: can't use the certificate in " in line
        process.send_signal(signal.SIGHUP)
        for line in process.stderr:
            if "ERROR" in line:
                break
        assert "the certificate stays as it was" in line
        assert _serial(url, context) == now
        process.send_signal(signal.SIGTERM)
        assert process.wait(fakes.WAIT_S) == -signal.SIGTERM


def test_the_metrics_have_the_date_of_expiry(authority: trustme.CA, serve: Serve, tmp_path: Path) -> None:
    for year in (2022, 2035):
        begins, expires = datetime(2020, 1, 1, tzinfo=UTC), datetime(year, 5, 6, 7, 8, 9, tzinfo=UTC)
        files = write_files(tmp_path, authority, not_before=begins, not_after=expires)
        url = serve(fakes.engine(), tls_certificate=files.certificate, tls_key=files.key)
        lines = httpx.get(f"{url}/metrics", verify=False).text.splitlines()  # noqa: S501 - it has expired
        (value,) = [line for line in lines if line.startswith("lane_certificate_expiry_timestamp_seconds ")]
        assert float(value.split()[1]) == expires.timestamp()


def _start_error(**settings: object) -> str:
    with pytest.raises(SettingsError) as caught, serving(fakes.engine(), Settings.model_validate(settings)):
        pass
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_files_that_cannot_be_used_end_the_start(files: Files, authority: trustme.CA, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    other = write_files(tmp_path / "other", authority)
    assert "missing.pem: no such file" in _start_error(tls_certificate=tmp_path / "missing.pem")
    assert "is a directory" in _start_error(tls_certificate=tmp_path)
    assert "key values mismatch" in _start_error(tls_certificate=files.certificate, tls_key=other.key)
    assert "can't use the certificate" in _start_error(tls_certificate=files.certificate)
    assert "can't use the certificate" in _start_error(tls_certificate=files.key, tls_key=files.certificate)
    (tmp_path / "empty.pem").touch()
    assert "can't use the certificate" in _start_error(tls_certificate=tmp_path / "empty.pem")
    with pytest.raises(SettingsError, match="tls_certificate is not"):
        load_settings(tls_key=files.key)


def test_a_key_with_a_password_ends_the_start(files: Files, tmp_path: Path) -> None:
    from cryptography.hazmat.primitives import serialization

    key = serialization.load_pem_private_key(files.key.read_bytes(), None)
    locked = tmp_path / "locked.pem"
    locked.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.BestAvailableEncryption(b"secret"),
        )
    )
    assert "without a password" in _start_error(tls_certificate=files.certificate, tls_key=locked)
