"""The preview over real sockets: its page, its pictures, its limits."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from http.client import HTTPConnection, HTTPResponse
from typing import Any
from urllib.parse import urlsplit

import cv2
import fakes
import numpy as np
import pytest
import rawclient

from lanestream.errors import SourceError
from lanestream.protocol import error_message
from lanestream.road.view import Image
from lanestream_client import preview as module
from lanestream_client.frames import SourceFrame, StreamResult
from lanestream_client.preview import Preview, has_display, preview


@pytest.fixture
def sink() -> Iterator[Preview]:
    with preview(True) as opened:
        assert opened is not None
        yield opened


def result(shade: int, size: tuple[int, int] = (180, 320)) -> StreamResult:
    """Returns a result without lanes on a frame of one shade."""
    frame = SourceFrame(shade, 0.04 * shade, pixels=np.full((*size, 3), shade, np.uint8))
    return StreamResult(frame, lanes=fakes.lanes(shade))


@contextmanager
def get(sink: Preview, path: str, method: str = "GET", **headers: str) -> Iterator[HTTPResponse]:
    connection = HTTPConnection(urlsplit(sink.url).netloc, timeout=fakes.WAIT_S)
    connection.request(method, path, headers=headers)
    with closing(connection), closing(connection.getresponse()) as response:
        yield response


def next_picture(response: HTTPResponse) -> Image:
    """Reads one part of a multipart response."""
    assert response.readline() == b"--frame\r\n"
    headers = {}
    while (line := response.readline()) != b"\r\n":
        name, _, value = line.decode().partition(": ")
        headers[name] = value.strip()
    assert headers["Content-Type"] == "image/jpeg"
    data = response.read(int(headers["Content-Length"]))
    assert response.read(2) == b"\r\n"
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), np.uint8)


def shade(picture: Image) -> int:
    """Returns the shade of a frame, from a corner that nothing is drawn on."""
    return round(float(picture[-20:, -20:].mean()))


def test_the_page_shows_the_pictures(sink: Preview) -> None:
    assert sink.url.startswith("http://127.0.0.1:")
    with get(sink, "/") as page:
        assert page.status == 200
        assert page.headers["Content-Type"] == "text/html; charset=utf-8"
        assert page.headers["Content-Security-Policy"].startswith("default-src 'none'")
        assert b'<img src="/frames"' in page.read()


def test_a_viewer_gets_the_newest_result_at_once_and_then_those_that_follow(sink: Preview) -> None:
    sink.write_result(result(40))
    sink.write_result(result(80))
    with get(sink, "/frames") as frames:
        assert frames.headers["Content-Type"] == "multipart/x-mixed-replace; boundary=frame"
        picture = next_picture(frames)
        assert picture.shape == (180, 320, 3)
        assert abs(shade(picture) - 80) < 3
        assert (picture[:60, :60] < 40).any(), "the legend is drawn"
        sink.write_result(result(120))
        assert abs(shade(next_picture(frames)) - 120) < 3


def test_pictures_are_of_limited_size(sink: Preview) -> None:
    sink.write_result(result(99, size=(1440, 2560)))
    with get(sink, "/frames") as frames:
        assert next_picture(frames).shape == (720, 1280, 3)


def test_results_that_come_too_fast_are_skipped(sink: Preview) -> None:
    with get(sink, "/frames") as frames:
        for number in range(200):
            sink.write_result(result(number))
        received = [shade(next_picture(frames))]
        while abs(received[-1] - 199) > 2:
            received.append(shade(next_picture(frames)))
    assert len(received) < 100
    assert received == sorted(received)


def test_nothing_is_drawn_while_nobody_watches(sink: Preview) -> None:
    drawn: list[int] = []

    class Counted(StreamResult):
        def draw(self, frame: Image | None = None) -> Image:
            drawn.append(self.frame.seq)
            return super().draw(frame)

    for number in range(5):
        sink.write_result(Counted(result(number).frame, lanes=fakes.lanes(number)))
    with get(sink, "/frames") as frames:
        next_picture(frames)
    assert drawn == [4]


def test_a_frame_that_cannot_be_decoded_is_left_out(sink: Preview) -> None:
    with get(sink, "/frames") as frames:
        error = error_message(SourceError("why"), seq=1)
        sink.write_result(StreamResult(SourceFrame(1, 0.0, data=b"no image"), error=error))
        fakes.pause(0.1)
        sink.write_result(result(120))
        assert abs(shade(next_picture(frames)) - 120) < 3


@pytest.mark.parametrize(
    ("request_of", "status"),
    [
        ({"path": "/nothing"}, 404),
        ({"path": "/../etc/passwd"}, 404),
        ({"path": "/", "method": "POST"}, 405),
        ({"path": "/", "Host": "rebound.example"}, 403),
        ({"path": "/frames", "Host": ""}, 403),
    ],
)
def test_other_requests_are_refused(sink: Preview, request_of: dict[str, Any], status: int) -> None:
    with get(sink, **request_of) as response:
        assert response.status == status
        assert response.read()


def test_there_are_at_most_four_viewers(sink: Preview) -> None:
    sink.write_result(result(50))
    with get(sink, "/frames") as a, get(sink, "/frames") as b, get(sink, "/frames") as c, get(sink, "/frames") as d:
        for viewer in (a, b, c, d):
            next_picture(viewer)
        with get(sink, "/frames") as fifth:
            assert fifth.status == 503
    # Viewers that left make room within seconds, even if no new frames come.
    for _ in range(int(fakes.WAIT_S / 0.1)):
        with get(sink, "/frames") as sixth:
            if sixth.status == 200:
                break
        fakes.pause(0.1)
    else:
        pytest.fail("the viewers that left still count")


def test_a_request_that_is_too_slow_or_too_long_is_dropped(sink: Preview, monkeypatch: pytest.MonkeyPatch) -> None:
    with rawclient.connect(sink.url) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nX: " + bytes(100_000))
        assert rawclient.read_all(connection) == b""
    monkeypatch.setattr(module, "_DEADLINE_S", 0.1)
    with rawclient.connect(sink.url) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\n")
        assert rawclient.read_all(connection) == b""


def test_a_viewer_that_does_not_read_is_dropped_and_delays_nobody(
    sink: Preview, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_DEADLINE_S", 0.3)
    noise = np.random.default_rng(0).integers(0, 255, (720, 1280, 3)).astype(np.uint8)
    host = urlsplit(sink.url).netloc
    with rawclient.connect(sink.url, read_buffer=1) as asleep, get(sink, "/frames") as awake:
        asleep.sendall(f"GET /frames HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
        for number in range(10):
            sink.write_result(StreamResult(SourceFrame(number, 0.0, pixels=noise), lanes=fakes.lanes(number)))
            next_picture(awake)
        fakes.pause(0.5)
        assert len(rawclient.read_all(asleep)) < 4_000_000


def test_closing_ends_all_viewers_and_frees_the_port(caplog: pytest.LogCaptureFixture) -> None:
    with preview(True) as opened:
        assert opened is not None
        url = opened.url
        opened.write_result(result(50))
        with get(opened, "/frames") as frames:
            next_picture(frames)
            opened.close()
            assert frames.read() in (b"", b"--frame\r\n")
    assert not caplog.records, "nothing is logged as an error"
    with socket.socket() as port:
        port.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        port.bind(("127.0.0.1", urlsplit(url).port))


def test_there_is_no_preview_unless_asked_for() -> None:
    with preview(False) as opened:
        assert opened is None


def test_a_display_is_known_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert not has_display()
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    assert has_display()
