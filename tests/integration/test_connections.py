"""Peers that send too much or too slowly, never read, or only connect: before any key is checked."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress

import bombs
import cv2
import fakes
import httpx
import numpy as np
import pytest
from rawclient import (
    BINARY,
    CONTINUATION,
    PING,
    TEXT,
    UPGRADE,
    connect,
    frame,
    is_closed,
    open_stream,
    read_all,
    send_until_closed,
)
from wsclient import receive, send_message, stream, wait_until_released

Serve = Callable[..., str]


def metric(url: str, name: str) -> float:
    """Returns the value of a metric, with its labels."""
    (value,) = [
        line.rpartition(" ")[2] for line in httpx.get(f"{url}/metrics").text.splitlines() if line.startswith(f"{name} ")
    ]
    return float(value)


@pytest.mark.parametrize(
    ("begin", "again", "status"),
    [
        (b"GET /healthz HTTP/1.1\r\nHost: x\r\n", b"X-More: 1\r\n" * 100, 431),
        (b"GET /healthz HTTP/1.1\r\nHost: x\r\nX: ", b"x" * 4096, 431),
        (b"GET /healthz HTTP/1.1\r\nHost: x\r\n", b"x" * 4096, 431),
        (b"GET /", b"x" * 4096, 414),
        (UPGRADE, b"X-More: 1\r\n" * 100, 431),
    ],
    ids=["headers", "value", "name", "target", "upgrade"],
)
def test_an_endless_head_is_refused(url: str, begin: bytes, again: bytes, status: int) -> None:
    with connect(url) as connection:
        connection.sendall(begin)
        send_until_closed(connection, again)
    with connect(url) as connection:
        connection.sendall(begin + 10 * again)
        assert read_all(connection).startswith(f"HTTP/1.1 {status} ".encode())


@pytest.mark.parametrize("path", ["/healthz", "/v1/detect"])
@pytest.mark.parametrize("again", [b"X-More: 1\r\n" * 100, b"x" * 4096], ids=["trailers", "trailer"])
def test_endless_trailers_end_the_connection(url: str, path: str, again: bytes) -> None:
    with connect(url) as connection:
        connection.sendall(f"POST {path} HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n".encode())
        connection.sendall(b"1\r\nx\r\n0\r\n")
        send_until_closed(connection, again)


def test_an_endless_chunk_extension_ends_the_connection(url: str) -> None:
    with connect(url) as connection:
        connection.sendall(b"POST /v1/detect HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n1;x=")
        send_until_closed(connection, b"x" * 4096)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        (b"Cookie: " + b"x" * 9000 + b"\r\n", 431),
        (b"X-More: 1\r\n" * 200, 431),
        (b"Content-Length: 5\r\n", 400),
        (b"Transfer-Encoding: chunked\r\n", 400),
    ],
    ids=["cookie", "headers", "body", "chunks"],
)
def test_a_handshake_that_the_library_refuses_is_answered(url: str, headers: bytes, status: int) -> None:
    with connect(url) as connection:
        connection.sendall(UPGRADE + headers + b"\r\n")
        head, _, body = read_all(connection).partition(b"\r\n\r\n")
    assert head.startswith(f"HTTP/1.1 {status} ".encode())
    assert json.loads(body).keys() == {"code", "message", "hint", "request_id"}


def test_a_body_that_goes_on_after_the_answer_ends_in_time(serve: Serve) -> None:
    url = serve(fakes.engine(), body_s=0.2)
    with connect(url) as connection:
        connection.sendall(b"POST /healthz HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000\r\n\r\n")
        assert connection.recv(1 << 16).startswith(b"HTTP/1.1 405 ")
        began = time.monotonic()
        with suppress(ConnectionError):
            while time.monotonic() < began + fakes.WAIT_S:
                connection.sendall(b"x")
                time.sleep(0.05)
        assert time.monotonic() < began + fakes.WAIT_S


def test_a_peer_that_still_sends_is_not_reset_by_the_answer(url: str) -> None:
    with connect(url) as connection:
        connection.sendall(b"POST /v1/detect HTTP/1.1\r\nHost: x\r\nContent-Length: 9000000\r\n\r\n")
        answer = read_all(connection)
        assert answer.startswith(b"HTTP/1.1 413 ")
        for _ in range(5):
            connection.sendall(bytes(100_000))
            time.sleep(0.02)


def test_line_ends_between_requests_do_not_keep_a_connection(url: str) -> None:
    with connect(url) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
        assert connection.recv(1 << 16).startswith(b"HTTP/1.1 200 ")
        began = time.monotonic()
        with suppress(ConnectionError):
            while time.monotonic() < began + 2 * fakes.WAIT_S:
                connection.sendall(b"\r\n")
                time.sleep(0.2)
        assert time.monotonic() < began + 2 * fakes.WAIT_S


def test_the_oldest_connection_without_a_session_gives_way(serve: Serve) -> None:
    url = serve(fakes.engine(), max_connections_per_address=8)
    with ExitStack() as stack, stream(url) as camera:
        send_message(camera, "start")
        receive(camera)
        idle = [stack.enter_context(connect(url)) for _ in range(20)]
        assert httpx.get(f"{url}/healthz").is_success, "another connection is always possible"
        assert all(is_closed(connection) for connection in idle[:12])
        camera.send(fakes.image_file())
        assert receive(camera)["type"] == "lanes", "a stream keeps its connection"
        assert metric(url, 'lane_connections_cut_total{reason="address_limit"}') >= 12


def test_an_address_with_many_connections_leaves_room_for_others(serve: Serve) -> None:
    url = serve(fakes.engine(), max_connections=10, max_connections_per_address=10, max_sessions=2)
    with ExitStack() as stack:
        other = stack.enter_context(connect(url, source="127.0.0.2"))
        for _ in range(20):
            stack.enter_context(connect(url))
        other.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
        assert other.recv(1 << 16).startswith(b"HTTP/1.1 200 ")


def test_a_stream_without_a_session_gives_way(serve: Serve) -> None:
    url = serve(fakes.engine(), max_connections_per_address=4)
    with ExitStack() as stack:
        for _ in range(8):
            open_stream(stack.enter_context(connect(url)))
        with stream(url) as camera:
            camera.send(fakes.image_file())
            assert receive(camera)["type"] == "lanes"


def test_pings_that_come_too_fast_are_read_slowly_and_all_answered(serve: Serve) -> None:
    url = serve(fakes.engine(), frames_per_s=50)
    with connect(url) as connection:
        open_stream(connection)
        began, left = time.monotonic(), 2000 * len(b"\x89\x00")
        connection.sendall(2000 * frame(PING))
        while left:
            left -= len(connection.recv(left))
        assert time.monotonic() - began > 1.0, "the burst is 960 pings, then 480 are read in a second"


def test_a_client_that_never_reads_loses_its_session(serve: Serve) -> None:
    url = serve(fakes.engine(), max_sessions=2, max_sessions_per_caller=1, send_s=0.3, frames_per_s=1000)
    with connect(url, read_buffer=4096) as silent:
        open_stream(silent)
        silent.sendall(frame(TEXT, b'{"type": "start", "mode": "latest"}'))
        # The answers fill the buffers of the system.
        send_until_closed(silent, 10 * frame(BINARY, fakes.image_file()), limit=1 << 30)
        wait_until_released(url)
        with stream(url) as camera:
            camera.send(fakes.image_file())
            assert receive(camera)["type"] == "lanes"


def test_pictures_that_are_never_read_are_given_up(serve: Serve) -> None:
    url = serve(fakes.engine(), send_s=0.3)
    noise = np.random.default_rng(1).integers(0, 255, (1440, 2560, 3), np.uint8)  # 11 MB as a PNG
    image = cv2.imencode(".jpg", noise)[1].tobytes()
    with ExitStack() as stack:
        for _ in range(4):
            connection = stack.enter_context(connect(url, read_buffer=4096))
            connection.sendall(
                b"POST /v1/detect HTTP/1.1\r\nHost: x\r\nAccept: image/png\r\n"
                + f"Content-Length: {len(image)}\r\n\r\n".encode()
                + image
            )
        deadline = time.monotonic() + fakes.WAIT_S
        while metric(url, 'lane_connections_cut_total{reason="send"}') < 4 and time.monotonic() < deadline:
            time.sleep(0.1)
        assert metric(url, 'lane_connections_cut_total{reason="send"}') == 4
        assert metric(url, "lane_buffered_bytes") == 0


def test_a_text_that_is_too_long_closes_the_stream_by_its_header(url: str) -> None:
    with connect(url) as connection:
        open_stream(connection)
        connection.sendall(frame(TEXT, b"x" * 70_000)[:20])
        assert b"65,536 bytes" in read_all(connection)
    with connect(url) as connection:
        open_stream(connection)
        connection.sendall(frame(TEXT, b"x" * 40_000, final=False) + frame(CONTINUATION, b"x" * 40_000))
        assert b"65,536 bytes" in read_all(connection)


def test_a_message_in_fragments_arrives(url: str) -> None:
    image = fakes.image_file()
    with connect(url) as connection:
        open_stream(connection)
        parts = [image[at : at + 1000] for at in range(0, len(image), 1000)]
        connection.sendall(frame(BINARY, parts[0], final=False))
        for part in parts[1:]:
            connection.sendall(frame(CONTINUATION, part, final=False) + frame(PING, b"between"))
        connection.sendall(frame(CONTINUATION))
        received = b""
        while b'"lanes"' not in received:
            received += connection.recv(1 << 16)
        assert received.count(b"between") == len(parts) - 1


def test_messages_that_come_too_fast_are_read_slowly_and_all_answered(serve: Serve) -> None:
    url = serve(fakes.engine(), frames_per_s=50)
    with stream(url) as camera:
        began = time.monotonic()
        for _ in range(600):
            camera.send("{}")
        codes = [receive(camera)["code"] for _ in range(600)]
        assert codes == ["bad_message"] * 600
        assert time.monotonic() - began > 1.0, "the burst is 240 messages, then 120 are read in a second"


def test_text_that_is_not_utf8_closes_the_stream_in_order(url: str, caplog: pytest.LogCaptureFixture) -> None:
    with connect(url) as connection:
        open_stream(connection)
        connection.sendall(frame(TEXT, b"\xff\xfe"))
        assert b"not UTF-8" in read_all(connection)
    assert not [record for record in caplog.records if record.exc_info]


def test_unfinished_messages_are_limited_together(serve: Serve) -> None:
    url = serve(fakes.engine(), max_bytes=1 << 20, max_buffered_bytes=8 << 20, send_s=0.3)
    with ExitStack() as stack:
        connections = [stack.enter_context(connect(url)) for _ in range(6)]
        for connection in connections:
            open_stream(connection)
            with suppress(ConnectionError):
                connection.sendall(frame(BINARY, bytes(1 << 20))[:-1])
        assert b'"busy"' in read_all(connections[-1])
        assert httpx.post(f"{url}/v1/detect", content=fakes.image_file()).status_code == 200


def test_frames_beyond_the_memory_of_a_caller_are_refused_or_wait(serve: Serve) -> None:
    network = fakes.GatedModel()
    url = serve(fakes.engine(network), max_buffered_bytes=1 << 20)
    image = bombs.png(320, 180, extra=bombs.png_chunk(b"tEXt", bytes(200_000)))
    with stream(url) as camera:
        send_message(camera, "start", mode="all")
        receive(camera)
        for _ in range(4):
            camera.send(image)
        network.wait_for_a_frame()
        assert 0 < metric(url, "lane_buffered_bytes") <= 1 << 18
        network.let_through(4)
        answers = [receive(camera) for _ in range(4)]
        assert [answer["seq"] for answer in answers] == [0, 1, 2, 3]
        assert {answer.get("code", "lanes") for answer in answers} <= {"lanes", "busy"}
    wait_until_released(url)
    assert metric(url, "lane_buffered_bytes") == 0


def test_many_requests_in_one_packet_are_answered(url: str) -> None:
    with connect(url) as connection:
        connection.sendall(20 * b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
        answers = b""
        while answers.count(b"alive") < 20:
            answers += connection.recv(1 << 16)


def test_answers_that_are_never_read_end_the_connection(serve: Serve) -> None:
    url = serve(fakes.engine(), send_s=0.3)
    with connect(url, read_buffer=4096) as connection:
        send_until_closed(connection, 100 * b"GET /openapi.json HTTP/1.1\r\nHost: x\r\n\r\n")
