"""A preview of a stream in a browser: a local page with the newest frame and its lanes.

The OpenCV that `lanestream[video]` installs opens no windows. A browser also works on a machine reached over SSH.
"""

from __future__ import annotations

import asyncio
import os
import socket
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from http import HTTPStatus
from typing import TYPE_CHECKING, Final

from lanestream.errors import ImageError, SourceError, needs_extra
from lanestream_client.pixels import encode_jpeg

if TYPE_CHECKING:
    from lanestream_client.frames import StreamResult

_HOST: Final = "127.0.0.1"
_MOST_CONNECTIONS: Final = 16
_MOST_VIEWERS: Final = 4
_MOST_HEAD_BYTES: Final = 16 << 10
# The time for a request to arrive, and for a viewer to take a picture or a page.
_DEADLINE_S: Final = 5.0
# How soon a viewer that left is noticed while there are no new frames.
_CHECK_S: Final = 1.0
# Limits that keep the preview cheap: pictures per second, their width, the quality of their JPEG files, and how many
# bytes of them the system buffers for a viewer, who else would see old frames.
_MOST_FPS: Final = 20.0
_MOST_WIDTH: Final = 1280
_JPEG_QUALITY: Final = 80
_SEND_BUFFER: Final = 64 << 10

_PAGE: Final = b"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>Lanestream preview</title>
<style>
html, body { margin: 0; height: 100%; background: #14181c }
img { display: block; width: 100%; height: 100%; object-fit: contain }
</style>
<img src="/frames" alt="Newest frame with its lanes">
</html>
"""


class Preview:
    """A sink that shows the newest result on the page at `url`. Older results that nobody has seen yet are skipped.

    A thread of its own draws and sends, so that neither drawing nor a slow viewer delays the stream. It draws only
    while someone watches.
    """

    def __init__(self) -> None:
        self._newest: StreamResult | None = None
        self._picture = b""
        self._drawn = 0
        self._connections = 0
        self._viewers = 0
        started: Future[int] = Future()
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._serve(started)), name="lanestream-preview", daemon=True
        )
        self._thread.start()
        self._port = started.result()

    @property
    def url(self) -> str:
        """The address of the page, on this machine."""
        return f"http://{_HOST}:{self._port}/"

    def write_result(self, result: StreamResult) -> None:
        """Shows one result instead of the one before."""
        self._newest = result
        self._loop.call_soon_threadsafe(self._arrived.set)

    def close(self) -> None:
        """Disconnects all viewers. Browsers keep showing the last frame."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._closed.set)
            self._thread.join()

    async def _serve(self, started: Future[int]) -> None:
        self._loop = asyncio.get_running_loop()
        self._arrived, self._closed, self._changed = asyncio.Event(), asyncio.Event(), asyncio.Condition()
        try:
            server = await asyncio.start_server(self._accept, _HOST, 0, limit=_MOST_HEAD_BYTES)
        except OSError as error:
            started.set_exception(SourceError(f"can't open a port for the preview: {error.strerror or error}"))
            return
        drawing = asyncio.create_task(self._draw_newest())
        started.set_result(server.sockets[0].getsockname()[1])
        await self._closed.wait()
        server.close()
        drawing.cancel()

    async def _draw_newest(self) -> None:
        """Draws the newest result each time that there is another one, for as long as someone watches."""
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            if self._viewers and self._newest is not None:
                with suppress(ImageError):
                    self._picture = _picture(self._newest)
                    async with self._changed:
                        self._drawn += 1
                        self._changed.notify_all()
                await asyncio.sleep(1.0 / _MOST_FPS)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._connections += 1
        try:
            if self._connections <= _MOST_CONNECTIONS:
                await self._answer(reader, writer)
                writer.close()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # the peer left, or was too slow
        except asyncio.CancelledError:
            pass  # the preview was closed; Python 3.11 would print a traceback for a canceled task
        finally:
            self._connections -= 1
            if not writer.is_closing():
                writer.transport.abort()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.transport.set_write_buffer_limits(high=0)  # so that `drain` waits until all was sent
        async with asyncio.timeout(_DEADLINE_S):
            head = await reader.readuntil(b"\r\n\r\n")
        status, path = self._check(head)
        if status is HTTPStatus.OK and path == "/frames":
            await self._send_pictures(reader, writer)
        elif status is HTTPStatus.OK:
            await _send(writer, _head(status, "text/html; charset=utf-8") + _PAGE)
        else:
            await _send(writer, _head(status, "text/plain; charset=utf-8") + f"{status.phrase}\n".encode())

    def _check(self, head: bytes) -> tuple[HTTPStatus, str]:
        """Returns the status of the response to a request, and the requested path."""
        request, *fields = head.decode("latin-1").split("\r\n")
        method, path, *_ = [*request.split(" "), "", ""]
        hosts = [
            value.strip() for name, _, value in (field.partition(":") for field in fields) if name.lower() == "host"
        ]
        # A web page whose host name was made to resolve to this machine could otherwise read the pictures.
        if hosts not in ([f"{_HOST}:{self._port}"], [f"localhost:{self._port}"]):
            return HTTPStatus.FORBIDDEN, path
        if path not in ("/", "/frames"):
            return HTTPStatus.NOT_FOUND, path
        if method != "GET":
            return HTTPStatus.METHOD_NOT_ALLOWED, path
        if path == "/frames" and self._viewers >= _MOST_VIEWERS:
            return HTTPStatus.SERVICE_UNAVAILABLE, path
        return HTTPStatus.OK, path

    async def _send_pictures(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Sends the newest picture again and again, each as soon as the viewer has taken the one before."""
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self._viewers += 1
        try:
            await _send(writer, _head(HTTPStatus.OK, "multipart/x-mixed-replace; boundary=frame") + b"--frame\r\n")
            sent = self._drawn
            self._arrived.set()
            while not reader.at_eof():
                with suppress(TimeoutError):
                    async with asyncio.timeout(_CHECK_S), self._changed:
                        while self._drawn == sent:
                            await self._changed.wait()
                if self._drawn > sent:
                    sent = self._drawn
                    size = f"Content-Type: image/jpeg\r\nContent-Length: {len(self._picture)}\r\n\r\n".encode()
                    # The next boundary follows at once: browsers show a picture when it has ended.
                    await _send(writer, size + self._picture + b"\r\n--frame\r\n")
        finally:
            self._viewers -= 1


@contextmanager
def preview(show: bool) -> Iterator[Preview | None]:
    """Opens a preview on a free port of 127.0.0.1. Yields None if `show` is false.

    Raises SourceError if no port can be opened.
    """
    if not show:
        yield None
        return
    with needs_extra("video"):
        import lanestream_client.overlays  # noqa: F401
    sink = Preview()
    try:
        yield sink
    finally:
        sink.close()


def has_display() -> bool:
    """Returns whether a browser can open a window here, as far as the environment says."""
    return sys.platform in ("darwin", "win32") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def _picture(result: StreamResult) -> bytes:
    """Returns a result as a JPEG of limited size. Raises ImageError if its frame can't be decoded."""
    import cv2
    import numpy as np

    image = result.draw()
    height, width = image.shape[:2]
    if width > _MOST_WIDTH:
        size = _MOST_WIDTH, max(1, round(height * _MOST_WIDTH / width))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return encode_jpeg(image, _JPEG_QUALITY)


def _head(status: HTTPStatus, content_type: str) -> bytes:
    """Returns the head of a response that other sites can't embed and that no cache keeps."""
    lines = (
        f"HTTP/1.1 {status.value} {status.phrase}",
        f"Content-Type: {content_type}",
        "Content-Security-Policy: default-src 'none'; img-src 'self'; style-src 'unsafe-inline'",
        "X-Frame-Options: DENY",
        "Cross-Origin-Resource-Policy: same-origin",
        "X-Content-Type-Options: nosniff",
        "Cache-Control: no-store",
        "Connection: close",
    )
    return "\r\n".join([*lines, "", ""]).encode("latin-1")


async def _send(writer: asyncio.StreamWriter, data: bytes) -> None:
    """Sends `data`. Raises TimeoutError if the peer does not take it in time."""
    writer.write(data)
    async with asyncio.timeout(_DEADLINE_S):
        await writer.drain()
