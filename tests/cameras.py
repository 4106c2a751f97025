"""Network cameras on real sockets: MJPEG over HTTP, and H.264 over RTSP with its packets in TCP or UDP."""

from __future__ import annotations

import base64
import itertools
import socket
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from typing import Self

import av
import cv2
import fakes
import numpy as np

WIDTH, HEIGHT = 320, 180
_MOST_RTP_BYTES = 1200
_RTP_CLOCK = 90_000
_FIRST_TIMESTAMP = 2**32 - 90_001  # so that it overflows after a second, as it does in long streams


def jpeg(number: int = 0) -> bytes:
    """Returns a JPEG whose gray level depends on `number`."""
    return cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), 20 * (number % 12), np.uint8))[1].tobytes()


def part(body: bytes, kind: str = "image/jpeg") -> bytes:
    """Returns a part of a multipart stream."""
    return b"--frame\r\nContent-Type: %b\r\nContent-Length: %d\r\n\r\n%b\r\n" % (kind.encode(), len(body), body)


class Camera:
    """A server that handles each connection in a thread, until the `with` block ends or it is told to stop."""

    scheme = "http"

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.connections = 0
        self._open: list[socket.socket] = []
        self._stopped = threading.Event()
        self._threads = [threading.Thread(target=self._accept, name="camera")]

    @property
    def url(self) -> str:
        """The camera's URL."""
        return f"{self.scheme}://127.0.0.1:{self.port}/live"

    def __enter__(self) -> Self:
        self._threads[0].start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for end in self._open:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(fakes.WAIT_S)
            assert not thread.is_alive()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                end, _ = self._listener.accept()
                self._open.append(end)
                self.connections += 1
                thread = threading.Thread(target=self._serve, args=(end, self.connections), name="camera-connection")
                self._threads.append(thread)
                thread.start()

    def _serve(self, end: socket.socket, number: int) -> None:
        with suppress(OSError), end:
            self.serve(end, number)

    def serve(self, end: socket.socket, number: int) -> None:
        """Serves a connection; `number` counts them from 1."""
        raise NotImplementedError

    def wait(self, seconds: float) -> None:
        """Sleeps, or raises OSError if the camera stops meanwhile."""
        if self._stopped.wait(seconds):
            raise OSError("stopped")


class MjpegCamera(Camera):
    """Sends the parts of each connection at `fps`, then closes it, or is silent if `stalls`.

    `parts` are those of the first connection, of the second one and so on; later connections are refused. `sent` are
    the times of this machine's monotonic clock at which the parts were sent.
    """

    def __init__(self, *parts: Sequence[bytes], fps: float = 50.0, stalls: bool = False) -> None:
        super().__init__()
        self._parts = parts
        self._fps = fps
        self._stalls = stalls
        self.sent: list[float] = []

    def serve(self, end: socket.socket, number: int) -> None:
        """Serves a connection."""
        end.recv(65536)
        if number > len(self._parts):
            end.sendall(b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            return
        end.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n")
        start = time.monotonic()
        for count, body in enumerate(self._parts[number - 1], start=1):
            self.sent.append(time.monotonic())
            end.sendall(body)
            self.wait(max(0.0, start + count / self._fps - time.monotonic()))
        if self._stalls:
            self.wait(fakes.WAIT_S)


@cache
def access_units(count: int = 12) -> tuple[tuple[bytes, ...], ...]:
    """Returns the NAL units of `count` H.264 frames, of which each can be decoded on its own."""
    codec = av.CodecContext.create("libx264", "w")
    assert isinstance(codec, av.VideoCodecContext)
    codec.width, codec.height, codec.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    codec.time_base = Fraction(1, 25)
    codec.options = {"preset": "ultrafast", "tune": "zerolatency", "g": "1", "x264-params": "annexb=1:repeat-headers=1"}
    rng = np.random.default_rng(5)
    units = []
    for number in range(count):
        image = np.full((HEIGHT, WIDTH, 3), 20 * number, np.uint8)
        image[:40, :40] = rng.integers(0, 255, (40, 40, 3))  # so that a frame needs several RTP packets
        frame = av.VideoFrame.from_ndarray(image, "bgr24")
        frame.pts = number
        units += [bytes(packet) for packet in codec.encode(frame)]
    return tuple(_nal_units(unit) for unit in units)


def _nal_units(unit: bytes) -> tuple[bytes, ...]:
    return tuple(nal for nal in unit.replace(b"\0\0\0\1", b"\0\0\1").split(b"\0\0\1") if nal)


def rtp_packets(nals: Sequence[bytes], sequence: Iterator[int], timestamp: int) -> Iterator[bytes]:
    """Yields the RTP packets of one frame: single NAL units, and fragments of large ones (RFC 6184, FU-A)."""
    for index, nal in enumerate(nals):
        pieces = [nal]
        if len(nal) > _MOST_RTP_BYTES:
            chunks = [nal[start : start + _MOST_RTP_BYTES] for start in range(1, len(nal), _MOST_RTP_BYTES)]
            last = len(chunks) - 1
            pieces = [
                bytes([nal[0] & 0xE0 | 28, (at == 0) << 7 | (at == last) << 6 | nal[0] & 0x1F]) + chunk
                for at, chunk in enumerate(chunks)
            ]
        for at, piece in enumerate(pieces):
            marker = index == len(nals) - 1 and at == len(pieces) - 1
            number = next(sequence) & 0xFFFF
            yield struct.pack("!BBHII", 0x80, marker << 7 | 96, number, timestamp & 0xFFFFFFFF, 7) + piece


@dataclass
class RtspRequest:
    """A request of the client."""

    method: str
    headers: dict[str, str] = field(default_factory=dict)


class RtspCamera(Camera):
    """Sends H.264 at `fps`: `counts` frames in the first connection, the second one and so on, then hangs up.

    It stays silent instead if `stalls`. `transports` are those that it accepts; to others it answers `refusal`. Over
    those that are `silent` it sends nothing.
    `clock` scales its timestamps: 1 is right, 0 stands still. `duration` is announced in seconds, as of a recording.
    A `login`, `user:password`, is asked for.
    """

    scheme = "rtsp"

    def __init__(
        self,
        *counts: int,
        transports: Sequence[str] = ("tcp", "udp"),
        refusal: str = "461 Unsupported Transport",
        silent: Sequence[str] = (),
        fps: float = 50.0,
        clock: float = 1.0,
        stalls: bool = False,
        duration: float | None = None,
        login: str | None = None,
    ) -> None:
        super().__init__()
        self._counts = counts
        self._transports = transports
        self._refusal = refusal
        self._silent = silent
        self._fps = fps
        self._clock = clock
        self._stalls = stalls
        self._duration = duration
        self._login = login
        self.setups: list[str] = []

    def serve(self, end: socket.socket, number: int) -> None:
        """Serves a connection."""
        target: tuple[str, int] | None = None
        while request := _read_request(end):
            headers = {"CSeq": request.headers.get("cseq", "0"), "Session": "7"}
            status, body = "200 OK", b""
            if request.method == "OPTIONS":
                headers["Public"] = "DESCRIBE, SETUP, PLAY, TEARDOWN"
            elif self._login is not None and not self._authorized(request):
                status, headers["WWW-Authenticate"] = "401 Unauthorized", 'Basic realm="camera"'
            elif request.method == "DESCRIBE":
                headers["Content-Type"], body = "application/sdp", self._description()
            elif request.method == "SETUP":
                asked = request.headers["transport"]
                transport = "tcp" if "TCP" in asked else "udp"
                self.setups.append(transport)
                if transport not in self._transports:
                    status = self._refusal
                elif transport == "tcp":
                    headers["Transport"] = "RTP/AVP/TCP;unicast;interleaved=0-1"
                else:
                    port = int(asked.split("client_port=")[1].split("-")[0])
                    target = ("127.0.0.1", port)
                    headers["Transport"] = f"RTP/AVP;unicast;client_port={port}-{port + 1};server_port=5000-5001"
            fields = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
            end.sendall(f"RTSP/1.0 {status}\r\n{fields}Content-Length: {len(body)}\r\n\r\n".encode() + body)
            if request.method == "PLAY":
                self._play(end, target, self._counts[min(number, len(self._counts)) - 1])
                return

    def _play(self, end: socket.socket, target: tuple[str, int] | None, count: int) -> None:
        sequence = itertools.count()
        units = access_units()
        start = time.monotonic()
        if ("tcp" if target is None else "udp") in self._silent:
            self.wait(fakes.WAIT_S)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as datagrams:
            for number in range(count):
                timestamp = _FIRST_TIMESTAMP + round(number / self._fps * self._clock * _RTP_CLOCK)
                for packet in rtp_packets(units[number % len(units)], sequence, timestamp):
                    if target is None:
                        end.sendall(struct.pack("!cBH", b"$", 0, len(packet)) + packet)
                    else:
                        datagrams.sendto(packet, target)
                self.wait(max(0.0, start + (number + 1) / self._fps - time.monotonic()))
        if self._stalls:
            self.wait(3 * fakes.WAIT_S)

    def _authorized(self, request: RtspRequest) -> bool:
        expected = base64.b64encode((self._login or "").encode()).decode()
        return request.headers.get("authorization") == f"Basic {expected}"

    def _description(self) -> bytes:
        sets = ",".join(base64.b64encode(nal).decode() for nal in access_units()[0] if nal[0] & 0x1F in {7, 8})
        length = "" if self._duration is None else f"{self._duration:.3f}"
        return (
            "v=0\r\no=- 1 1 IN IP4 127.0.0.1\r\ns=camera\r\nc=IN IP4 0.0.0.0\r\nt=0 0\r\n"
            f"a=range:npt=0-{length}\r\nm=video 0 RTP/AVP 96\r\na=rtpmap:96 H264/{_RTP_CLOCK}\r\n"
            f"a=fmtp:96 packetization-mode=1;sprop-parameter-sets={sets}\r\na=control:track1\r\n"
        ).encode()


def _read_request(end: socket.socket) -> RtspRequest | None:
    data = b""
    while not data.endswith(b"\r\n\r\n"):
        byte = end.recv(1)
        if not byte:
            return None
        data += byte
    first, *rest = data.decode().strip().split("\r\n")
    headers = dict(line.split(": ", 1) for line in rest if ": " in line)
    return RtspRequest(first.split(" ")[0], {name.lower(): value for name, value in headers.items()})
