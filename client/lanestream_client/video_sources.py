"""Opens video files, cameras and network streams, each as a CameraSource."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from lanestream.errors import LanestreamError, SourceError, needs_extra
from lanestream_client.frames import CameraSource, SourceCounts, SourceFrame
from lanestream_client.live_source import Feed, LiveSource
from lanestream_client.proxies import find_proxy
from lanestream_client.redaction import redact_url, with_escaped_login
from lanestream_client.video_decoding import (
    DecodedFrame,
    VideoError,
    VideoRefusedError,
    decode_video,
    open_video,
    why_unreadable,
)

if TYPE_CHECKING:
    import av
    import cv2

    from lanestream_client.frames import Clock

RtspTransport = Literal["auto", "tcp", "udp"]

SOURCE_HINT: Final = "use a video file, a folder of images, an image, a camera number or an rtsp:// or http:// URL"
# The longest time to open a network stream, and without data from it.
_NETWORK_TIMEOUT_S: Final = 10.0
# A recording that ends before this share of its duration was cut off. Its duration is often an estimate.
_SHORTEST_SHARE: Final = 0.9
_RTSP: Final = frozenset({"rtsp", "rtsps"})
_HTTP: Final = frozenset({"http", "https"})
_NO_TIMESTAMPS: Final = 0x80  # FFmpeg's AVFMT_NOTIMESTAMPS


@contextmanager
def open_video_file(path: str, threads: int | None = None) -> Iterator[CameraSource]:
    """Opens a video file, to be decoded in this number of threads, or in FFmpeg's number if it is None.

    Raises SourceError if it can't be read.
    """
    try:
        container = open_video(f"file:{path}")  # so that no name is taken for a URL, such as 12:30.mp4
    except VideoError as error:
        known = why_unreadable(Path(path))
        reason, hint = (str(error), SOURCE_HINT) if known is None else known
        raise SourceError(f"can't open {path}: {reason}", hint) from None
    with container:
        if threads is not None:
            container.streams.video[0].codec_context.thread_count = threads
        yield _recording(container, path)


@contextmanager
def open_network_stream(
    url: str, reconnect_s: float, transport: RtspTransport, notify: Callable[[str], None]
) -> Iterator[CameraSource]:
    """Opens a network stream. It is live if neither its duration nor its size is known. Raises SourceError."""
    name = redact_url(url)
    counts = SourceCounts()
    try:
        # In a thread, because PyAV loses a Ctrl-C that comes while the main thread waits for data.
        with ThreadPoolExecutor(1) as thread:
            opened = thread.submit(_open_network, url, transport, counts).result()
    except VideoError as error:
        hint = SOURCE_HINT if _is_direct(url) else "check the camera and the proxy, or add the camera to NO_PROXY"
        raise SourceError(f"can't open {name}: {error}", hint) from None
    if not isinstance(opened, Feed):
        with opened:
            yield _recording(opened, name)
        return

    def reopen() -> Feed:
        again = _open_network(url, transport, counts)
        if not isinstance(again, Feed):
            again.close()
            raise VideoError("it is no longer a live stream")
        return again

    with _live(name, opened, reopen, reconnect_s, counts, notify) as source:
        yield source


def _open_network(url: str, transport: RtspTransport, counts: SourceCounts) -> Feed | av.container.InputContainer:
    """Opens a network stream, a live one with its first frame: a camera may agree to a transport and send nothing.

    Raises VideoError.
    """
    failures: list[str] = []
    for options in _options(url, transport):
        try:
            container = open_video(with_escaped_login(url), options, timeout_s=_NETWORK_TIMEOUT_S)
            # The size of a playlist is not that of its stream.
            has_size = container.size > 0 and not container.format.name.startswith(("hls", "dash"))
            if has_size or (container.duration or 0) > 0:
                return container
            return _live_feed(container, counts)
        except VideoError as error:
            failures.append(str(error))
            if isinstance(error, VideoRefusedError):
                break
    if len(set(failures)) > 1:
        raise VideoError(f"over TCP: {failures[0]}; over UDP: {failures[1]}")
    raise VideoError(failures[0])


def _live_feed(container: av.container.InputContainer, counts: SourceCounts) -> Feed:
    frames = decode_video(container, counts, stall_s=_NETWORK_TIMEOUT_S)
    try:
        first = next(frames, None)
        if first is None:
            raise VideoError("it ended before its first frame")
    except VideoError:
        container.close()
        raise
    return Feed(chain([first], frames), _frame_rate(container), _has_times(container), container.close)


def _options(url: str, transport: RtspTransport) -> list[dict[str, str]]:
    """Returns FFmpeg's options for a URL; for RTSP, those of each transport that is to be tried."""
    scheme = _scheme(url)
    if scheme in _RTSP:
        both = transport == "auto" and scheme == "rtsp"
        names = ["tcp", "udp"] if both else ["tcp" if transport == "auto" else transport]
        return [{"rtsp_transport": name} for name in names]
    # FFmpeg knows no networks in NO_PROXY, and would ask a proxy for cameras of this machine.
    return [{"http_proxy": ""} if scheme in _HTTP and _is_direct(url) else {}]


def _is_direct(url: str) -> bool:
    """Returns whether no proxy is set for a URL, by the rules for services."""
    if _scheme(url) not in _HTTP:
        return True
    try:
        return find_proxy(with_escaped_login(url)) is None
    except (LanestreamError, ValueError):
        return False


def _scheme(url: str) -> str:
    return url.partition("://")[0].lower()


def _recording(container: av.container.InputContainer, name: str) -> CameraSource:
    """Returns the frames of a video with an end, a file or a part of a network stream."""
    stream = container.streams.video[0]
    fps = _frame_rate(container)
    counts = SourceCounts()
    duration_s = None if container.duration is None or "://" not in name else container.duration / 1e6
    has_times = _has_times(container)

    def frames() -> Iterator[SourceFrame]:
        seq = -1
        timestamp = 0.0
        try:
            for seq, frame in enumerate(decode_video(container, counts)):
                clock: Clock = "source" if frame.time is not None and has_times else "frame_rate"
                timestamp = seq / fps if frame.time is None else frame.time
                yield SourceFrame(seq, timestamp, pixels=frame.pixels, clock=clock)
        except VideoError as error:
            raise SourceError(f"{name} failed after {seq + 1} frames: {error}") from None
        if seq < 0:
            raise SourceError(f"{name} has no frames" + (" that can be decoded" if counts.lost_frames else ""))
        if duration_s is not None and timestamp < _SHORTEST_SHARE * duration_s - 1.0:
            raise SourceError(f"{name} ended after {timestamp:.1f} of {duration_s:.1f} s: the connection was lost")

    return CameraSource(name, frames(), live=False, fps=fps, length=stream.frames or None, counts=counts)


def _frame_rate(container: av.container.InputContainer) -> float:
    stream = container.streams.video[0]
    return float(stream.average_rate or stream.guessed_rate or 25)


def _has_times(container: av.container.InputContainer) -> bool:
    """Returns whether the format has timestamps. For others, FFmpeg counts frames at a rate that it assumes."""
    return not container.format.flags & _NO_TIMESTAMPS


@contextmanager
def open_camera(device: int | str, reconnect_s: float, notify: Callable[[str], None]) -> Iterator[CameraSource]:
    """Opens a camera of this machine by its number or device file. Raises SourceError if it can't be opened."""
    name = f"camera {device}"
    with needs_extra("video"):
        import cv2

    def open_feed() -> Feed:
        capture = cv2.VideoCapture(device)
        if not capture.isOpened():
            capture.release()
            raise VideoError("was not found, or another program uses it")
        return Feed(_captured(capture), capture.get(cv2.CAP_PROP_FPS) or 30.0, has_times=False, close=capture.release)

    try:
        feed = open_feed()
    except VideoError as error:
        raise SourceError(f"{name} {error}", SOURCE_HINT) from None
    with _live(name, feed, open_feed, reconnect_s, SourceCounts(), notify) as source:
        yield source


def _captured(capture: cv2.VideoCapture) -> Iterator[DecodedFrame]:
    import numpy as np

    while True:
        requested = time.monotonic()
        success, pixels = capture.read()
        if not success:
            raise VideoError("stopped delivering frames")
        yield DecodedFrame(np.asarray(pixels, np.uint8), None, requested, time.monotonic())


@contextmanager
def _live(
    name: str,
    feed: Feed,
    reopen: Callable[[], Feed],
    reconnect_s: float,
    counts: SourceCounts,
    notify: Callable[[str], None],
) -> Iterator[CameraSource]:
    frames = LiveSource(name, feed, reopen, reconnect_s=reconnect_s, counts=counts, notify=notify)
    with closing(frames):
        yield CameraSource(name, frames, live=True, fps=feed.fps, counts=counts, stop=frames.stop)
