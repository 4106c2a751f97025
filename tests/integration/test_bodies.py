"""Requests that are slow, that lie about their length, or that no client library would send, over plain sockets."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable
from urllib.parse import urlsplit

import fakes
import httpx
import pytest
from talking import heard, stream, tell

Serve = Callable[..., str]
IMAGE = fakes.image_file()


def begun(url: str, *headers: str, body: bytes = b"") -> socket.socket:
    """A connection on which a request to find lanes has begun."""
    place = urlsplit(url)
    assert place.hostname is not None
    connection = socket.create_connection((place.hostname, place.port or 80), timeout=fakes.WAIT_S)
    lines = ["POST /v1/detect HTTP/1.1", "Host: x", *headers, "", ""]
    connection.sendall("\r\n".join(lines).encode() + body)
    return connection


def answer(connection: socket.socket) -> tuple[int, bytes, bytes]:
    """Status, headers and body of all that comes until the service closes."""
    data = b""
    while part := connection.recv(1 << 16):
        data += part
    head, _, body = data.partition(b"\r\n\r\n")
    return int(head.split()[1]), head.lower(), body


def refused(connection: socket.socket) -> tuple[int, str]:
    """Status and code of the one problem that the service tells before it closes the connection."""
    with connection:
        status, head, body = answer(connection)
    assert b"connection: close" in head
    told = json.loads(body)
    assert set(told) == {"code", "message", "hint"}
    return status, told["code"]


def lives(url: str) -> None:
    assert httpx.post(f"{url}/v1/detect", content=IMAGE).status_code == 200


@pytest.mark.parametrize(
    ("headers", "body"),
    [
        ([f"Content-Length: {len(IMAGE)}"], IMAGE[:500]),
        (["Content-Length: 5"], b""),
        (["Transfer-Encoding: chunked"], b"5\r\nhello\r\n"),
        (["Transfer-Encoding: chunked"], b""),
        ([f"Content-Length: {len(IMAGE)}", "Content-Type: multipart/form-data; boundary=b"], b"--b\r\n"),
    ],
)
def test_a_body_that_stops_is_waited_for_and_then_refused(serve: Serve, headers: list[str], body: bytes) -> None:
    place = serve(fakes.engine(), body_s=0.2)
    assert refused(begun(place, *headers, body=body)) == (408, "idle")
    metrics = httpx.get(f"{place}/metrics").text
    assert 'lane_refusals_total{code="idle"} 1.0' in metrics
    lives(place)


@pytest.mark.parametrize("said", [b"", b"G", b"GET /healthz HTTP/1.1\r\nHost: x\r\nX-Slow: "])
def test_a_head_that_stops_is_waited_for_and_then_refused(serve: Serve, said: bytes) -> None:
    place = urlsplit(serve(fakes.engine(), handshake_s=0.2))
    address = (place.hostname, place.port)
    with socket.create_connection(address, timeout=fakes.WAIT_S) as silent:
        silent.sendall(said)
        assert answer(silent)[:2] == (408, b"http/1.1 408 request timeout\r\nconnection: close\r\ncontent-length: 0")
    with socket.create_connection(address, timeout=fakes.WAIT_S) as second:
        second.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
        assert second.recv(1 << 16).startswith(b"HTTP/1.1 200 ")
        second.sendall(said)
        assert b"200 OK" not in b"".join(iter(lambda: second.recv(1 << 16), b""))
    lives(place.geturl())


def test_a_head_that_came_in_time_has_all_the_time_it_needs(serve: Serve) -> None:
    place = serve(fakes.engine(), handshake_s=0.2)
    with begun(place, f"Content-Length: {len(IMAGE)}", body=IMAGE[:500]) as slow, stream(place, mode="all") as camera:
        fakes.pause(0.5)
        slow.sendall(IMAGE[500:])
        assert slow.recv(1 << 16).startswith(b"HTTP/1.1 200 ")
        camera.send(IMAGE)
        assert heard(camera)["type"] == "lanes"


def test_a_slow_body_holds_no_session(serve: Serve) -> None:
    place = serve(fakes.engine(), max_sessions=1)
    with begun(place, f"Content-Length: {len(IMAGE)}", body=IMAGE[:500]) as slow:
        busy = httpx.post(f"{place}/v1/detect", content=IMAGE)
        assert (busy.status_code, busy.json()["code"]) == (503, "busy"), "one body at a time is received"
        with stream(place, mode="all") as camera:
            camera.send(IMAGE)
            assert heard(camera)["type"] == "lanes"
            tell(camera, "end")
            assert heard(camera)["type"] == "summary"
        slow.sendall(IMAGE[500:])
        assert slow.recv(1 << 16).startswith(b"HTTP/1.1 200 ")


def test_a_client_that_leaves_in_the_middle_frees_its_place(serve: Serve) -> None:
    place = serve(fakes.engine(), max_sessions=1)
    for _ in range(3):
        begun(place, f"Content-Length: {len(IMAGE)}", body=IMAGE[:500]).close()
        lives_again(place)


def lives_again(url: str) -> None:
    """Waits until the service has noticed that a client left."""
    while (response := httpx.post(f"{url}/v1/detect", content=IMAGE)).status_code == 503:
        assert response.json()["code"] == "busy"
    assert response.status_code == 200


def test_what_is_refused_anyway_is_refused_before_its_body_comes(serve: Serve) -> None:
    place = serve(fakes.engine(), max_bytes=10_000)
    for headers, told in (
        (["Content-Length: 999999999999"], (413, "image_too_large")),
        (["Content-Length: 80000", "Content-Type: multipart/form-data; boundary=b"], (413, "image_too_large")),
    ):
        assert refused(begun(place, *headers)) == told
    for headers, told in (
        (["Accept: text/html", "Content-Length: 9"], (406, "not_acceptable")),
        (["Origin: http://elsewhere", "Content-Length: 9"], (403, "forbidden")),
    ):
        with begun(place, *headers) as connection:
            head = connection.recv(1 << 16)
        assert int(head.split()[1]) == told[0]
        assert told[1].encode() in head


@pytest.mark.parametrize(
    "headers",
    [
        ["Content-Length: -1"],
        ["Content-Length: 1e3"],
        ["Content-Length: 99999999999999999999999999"],
        ["Content-Length: 5", "Content-Length: 6"],
        ["Content-Length: 5", "Transfer-Encoding: chunked"],
        ["Content-Length: 5"],
    ],
)
def test_a_length_that_is_a_lie_ends_the_connection(url: str, headers: list[str]) -> None:
    with begun(url, *headers, body=b"hello, how are you?") as connection:
        assert answer(connection)[0] == 400
    lives(url)


@pytest.mark.parametrize("charset", ["undefined", "idna", "utf-16", "hex", "no such"])
def test_a_form_in_an_odd_encoding_is_read_or_refused(url: str, charset: str) -> None:
    part = b'--b\r\nContent-Disposition: form-data; name="a..b"\r\n\r\nx\r\n--b--\r\n'
    kind = f'Multipart/Form-Data; boundary=b; charset="{charset}"'
    response = httpx.post(f"{url}/v1/detect", content=part, headers={"content-type": kind})
    assert (response.status_code, response.json()["code"]) == (422, "bad_message")
