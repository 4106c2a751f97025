"""Slow requests, wrong lengths and other requests that no client library would send, over plain sockets."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable
from urllib.parse import urlsplit

import fakes
import httpx
import pytest
from wsclient import receive, send_message, stream

Serve = Callable[..., str]
IMAGE = fakes.image_file()


def begin_request(url: str, *headers: str, body: bytes = b"") -> socket.socket:
    """Opens a connection and sends the beginning of a `POST /v1/detect`."""
    address = urlsplit(url)
    assert address.hostname is not None
    connection = socket.create_connection((address.hostname, address.port or 80), timeout=fakes.WAIT_S)
    lines = ["POST /v1/detect HTTP/1.1", "Host: x", *headers, "", ""]
    connection.sendall("\r\n".join(lines).encode() + body)
    return connection


def read_response(connection: socket.socket) -> tuple[int, bytes, bytes]:
    """Reads until the service closes the connection. Returns the status, the headers and the body."""
    data = b""
    while part := connection.recv(1 << 16):
        data += part
    head, _, body = data.partition(b"\r\n\r\n")
    return int(head.split()[1]), head.lower(), body


def read_problem(connection: socket.socket) -> tuple[int, str]:
    """Returns the status and code of the error response after which the service closes the connection."""
    with connection:
        status, head, body = read_response(connection)
    assert b"connection: close" in head
    problem = json.loads(body)
    assert set(problem) == {"code", "message", "hint", "request_id"}
    return status, problem["code"]


def check_alive(url: str) -> None:
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
def test_an_incomplete_body_is_refused_after_its_time_limit(serve: Serve, headers: list[str], body: bytes) -> None:
    url = serve(fakes.engine(), body_s=0.2)
    assert read_problem(begin_request(url, *headers, body=body)) == (408, "idle")
    metrics = httpx.get(f"{url}/metrics").text
    assert 'lane_refusals_total{code="idle"} 1.0' in metrics
    check_alive(url)


@pytest.mark.parametrize("sent", [b"", b"G", b"GET /healthz HTTP/1.1\r\nHost: x\r\nX-Slow: "])
def test_an_incomplete_head_is_refused_after_its_time_limit(serve: Serve, sent: bytes) -> None:
    url = serve(fakes.engine(), handshake_s=0.2)
    address = (urlsplit(url).hostname, urlsplit(url).port)
    with socket.create_connection(address, timeout=fakes.WAIT_S) as silent:
        silent.sendall(sent)
        assert read_problem(silent) == (408, "request_timeout")
    with socket.create_connection(address, timeout=fakes.WAIT_S) as second:
        second.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
        assert second.recv(1 << 16).startswith(b"HTTP/1.1 200 ")
        second.sendall(sent)
        assert b"200 OK" not in b"".join(iter(lambda: second.recv(1 << 16), b""))
    check_alive(url)


def test_the_time_limit_of_the_head_does_not_apply_to_the_body(serve: Serve) -> None:
    url = serve(fakes.engine(), handshake_s=0.2)
    with (
        begin_request(url, f"Content-Length: {len(IMAGE)}", body=IMAGE[:500]) as slow,
        stream(url, mode="all") as camera,
    ):
        fakes.pause(0.5)
        slow.sendall(IMAGE[500:])
        assert slow.recv(1 << 16).startswith(b"HTTP/1.1 200 ")
        camera.send(IMAGE)
        assert receive(camera)["type"] == "lanes"


def test_a_slow_body_does_not_occupy_a_session(serve: Serve) -> None:
    url = serve(fakes.engine(), max_sessions=1)
    with begin_request(url, f"Content-Length: {len(IMAGE)}", body=IMAGE[:500]) as slow:
        busy = httpx.post(f"{url}/v1/detect", content=IMAGE)
        assert (busy.status_code, busy.json()["code"]) == (503, "busy"), (
            "as many bodies are received at a time as there may be sessions"
        )
        with stream(url, mode="all") as camera:
            camera.send(IMAGE)
            assert receive(camera)["type"] == "lanes"
            send_message(camera, "end")
            assert receive(camera)["type"] == "summary"
        slow.sendall(IMAGE[500:])
        assert slow.recv(1 << 16).startswith(b"HTTP/1.1 200 ")


def test_a_client_that_disconnects_no_longer_counts(serve: Serve) -> None:
    url = serve(fakes.engine(), max_sessions=1)
    for _ in range(3):
        begin_request(url, f"Content-Length: {len(IMAGE)}", body=IMAGE[:500]).close()
        wait_until_accepted(url)


def wait_until_accepted(url: str) -> None:
    """Repeats a request until the service has noticed that a client disconnected."""
    while (response := httpx.post(f"{url}/v1/detect", content=IMAGE)).status_code == 503:
        assert response.json()["code"] == "busy"
    assert response.status_code == 200


def test_requests_are_refused_before_their_body_arrives_if_possible(serve: Serve) -> None:
    url = serve(fakes.engine(), max_bytes=10_000)
    for headers, expected in (
        (["Content-Length: 999999999999"], (413, "image_too_large")),
        (["Content-Length: 80000", "Content-Type: multipart/form-data; boundary=b"], (413, "image_too_large")),
    ):
        assert read_problem(begin_request(url, *headers)) == expected
    for headers, expected in (
        (["Accept: text/html", "Content-Length: 9"], (406, "not_acceptable")),
        (["Origin: http://elsewhere", "Content-Length: 9"], (403, "forbidden")),
    ):
        with begin_request(url, *headers) as connection:
            head = connection.recv(1 << 16)
        assert int(head.split()[1]) == expected[0]
        assert expected[1].encode() in head


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
def test_a_wrong_length_closes_the_connection(url: str, headers: list[str]) -> None:
    with begin_request(url, *headers, body=b"hello, how are you?") as connection:
        assert read_response(connection)[0] == 400
    check_alive(url)


@pytest.mark.parametrize("charset", ["undefined", "idna", "utf-16", "hex", "no such"])
def test_a_form_in_an_unusual_encoding_is_refused(url: str, charset: str) -> None:
    part = b'--b\r\nContent-Disposition: form-data; name="a..b"\r\n\r\nx\r\n--b--\r\n'
    kind = f'Multipart/Form-Data; boundary=b; charset="{charset}"'
    response = httpx.post(f"{url}/v1/detect", content=part, headers={"content-type": kind})
    assert (response.status_code, response.json()["code"]) == (422, "bad_message")
