"""Opens video files and network streams with FFmpeg, and decodes them past what can't be decoded."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final, cast

from lanestream.errors import needs_extra
from lanestream_client.redaction import redact_urls

if TYPE_CHECKING:
    import av
    from av.buffer import Buffer

    from lanestream_client.frames import SourceCounts
    from lanestream_client.pixels import BgrImage

# Bytes that FFmpeg can't make packets of cost at most this many attempts to go on behind them.
_MOST_ATTEMPTS: Final = 64
# The boxes that an MP4 or QuickTime file starts with.
_FIRST_BOXES: Final = (b"ftyp", b"wide", b"mdat", b"free", b"skip", b"moov", b"styp", b"moof", b"sidx")


class VideoError(Exception):
    """A video can't be opened or read any further. Its text says why, in words that follow the name of the video."""


class VideoRefusedError(VideoError):
    """The server refuses to send the video, over whatever transport."""


@dataclass(frozen=True)
class DecodedFrame:
    """A decoded frame: BGR `pixels` (H, W, 3) uint8 and the `time` of the file or stream in seconds, if it has one.

    `requested` and `arrived` are seconds of this machine's monotonic clock: when the reader began to wait for the
    frame, and when its bytes came.
    """

    pixels: BgrImage
    time: float | None
    requested: float
    arrived: float


def open_video(
    url: str, options: Mapping[str, str] | None = None, *, timeout_s: float | None = None
) -> av.container.InputContainer:
    """Opens a video by its URL, with `options` of FFmpeg.

    `timeout_s` limits opening it, and later each wait for data; None means no limit. Raises VideoError if it can't be
    opened or has no video, and its subclass VideoRefusedError if the server refuses.
    """
    with needs_extra("video"):
        import av
    try:
        container = av.open(url, options=dict(options or {}), timeout=timeout_s)
    except av.error.ExitError:
        raise VideoError(f"no answer within {timeout_s or 0:g} s") from None
    except (
        av.error.HTTPUnauthorizedError,
        av.error.HTTPForbiddenError,
        av.error.HTTPNotFoundError,
        av.error.ConnectionRefusedError,
    ) as error:
        raise VideoRefusedError(_reason(error)) from None
    except (av.FFmpegError, OSError) as error:
        raise VideoError(_reason(error)) from None
    if not container.streams.video:
        container.close()
        raise VideoError("it has no video stream")
    return container


def decode_video(
    container: av.container.InputContainer, counts: SourceCounts, *, stall_s: float | None = None
) -> Iterator[DecodedFrame]:
    """Yields the frames of the first video stream, upright. Counts those that can't be decoded, and goes on.

    `stall_s` is the longest time without a frame, for a live stream, and None for others. Raises VideoError if reading
    fails or stalls.
    """
    import av

    stream = container.streams.video[0]
    # Frames that are decoded in parallel come late by one frame per thread, which a live stream can't afford.
    stream.thread_type = "AUTO" if stall_s is None else "SLICE"
    held: av.Packet[Any] | None = None  # without data: an empty frame, or the end, which flushes the decoder
    packets = 0
    requested = last_frame = time.monotonic()
    try:
        for packet in _packets(container, counts):
            arrived = time.monotonic()
            frames: Sequence[av.VideoFrame] = ()
            if packet.stream_index == stream.index:
                packets += 1
                counts.lost_frames += held is not None
                held = None if packet.size else packet
                frames = _decode(packet, counts) if packet.size else ()
            for frame in frames:
                yield DecodedFrame(_upright(frame), frame.time, requested, arrived)
            if frames:
                requested = last_frame = time.monotonic()
            elif stall_s is not None and arrived - last_frame > stall_s:
                raise VideoError(f"stalled: it sends data, but no frame that can be decoded for {stall_s:g} s")
    except av.error.ExitError:
        raise VideoError(f"stalled: no data for {container.read_timeout or 0:g} s") from None
    except (av.FFmpegError, OSError) as error:
        raise VideoError(f"failed: {_reason(error)}") from None
    arrived = time.monotonic()
    for frame in [] if held is None else _decode(held, counts):
        yield DecodedFrame(_upright(frame), frame.time, requested, arrived)
    # Damaged parts of some files are skipped without an error. MP4 files may count frames that are cut away on purpose.
    if stall_s is None and "mov" not in container.format.name:
        counts.lost_frames += max(0, stream.frames - (packets - (held is not None)))


def why_unreadable(path: Path) -> tuple[str, str] | None:
    """Returns what is wrong with a video file that FFmpeg can't read, and what to do; None if that is unknown."""
    with suppress(OSError), path.open("rb") as file:
        size = path.stat().st_size
        if size == 0:
            return "the file is empty", "copy it again from the camera"
        start = file.read(64)
        if not start.strip(b"\0"):
            return "the file begins with zeros", "it was not written completely: copy it again from the camera"
        if start[4:8] not in _FIRST_BOXES:
            return None
        boxes = dict(_boxes(file, size))
        if b"moov" not in boxes:
            what = "it is a fragment without its header" if b"moof" in boxes else "the file has no index (`moov`)"
            hint = "the recording or a copy was cut off: copy it again, or rebuild the index with a repair tool"
            return what, hint
        if boxes[b"moov"] > size:
            return "the index (`moov`) is cut off", "the file is incomplete: copy it again from the camera"
    return None


def _reason(error: Exception) -> str:
    """Returns why FFmpeg failed, without the URL, which may have a password."""
    return redact_urls(getattr(error, "strerror", None) or str(error)).lower()


def _packets(container: av.container.InputContainer, counts: SourceCounts) -> Iterator[av.Packet[Any]]:
    """Yields the packets of all streams. Where bytes are damaged, continues behind them and counts one frame."""
    import av

    attempts = 0
    while True:
        try:
            for packet in container.demux():
                attempts = 0
                yield packet
        except av.error.InvalidDataError:
            attempts += 1
            counts.lost_frames += attempts == 1
            if attempts == _MOST_ATTEMPTS:
                raise
        else:
            return


def _decode(packet: av.Packet[Any], counts: SourceCounts) -> Sequence[av.VideoFrame]:
    import av

    try:
        return [frame for frame in packet.decode() if isinstance(frame, av.VideoFrame)]
    except av.error.InvalidDataError:
        counts.lost_frames += 1
        return ()


def _upright(frame: av.VideoFrame) -> BgrImage:
    """Returns the pixels as they are to be shown: turned and mirrored as the file or the camera says."""
    import numpy as np
    from av.sidedata.sidedata import Type

    pixels = np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)
    try:
        # PyAV's stubs list only a part of the keys.
        matrix = cast("Mapping[Type, Buffer]", frame.side_data)[Type.DISPLAYMATRIX]
    except KeyError:
        return pixels
    except ValueError:  # PyAV does not know every kind of side data, and then gives none of it
        return np.ascontiguousarray(np.rot90(pixels, round(frame.rotation / 90)))
    # A pixel at (x, y) is shown at (a x + c y, b x + d y), y down. What is not a multiple of 90 degrees is rounded.
    a, b, _, c, d, *_ = np.frombuffer(memoryview(matrix), np.int32).tolist()
    across, down = (a, d) if abs(a) + abs(d) >= abs(b) + abs(c) else (c, b)
    if (across, down) != (a, d):
        pixels = pixels.transpose(1, 0, 2)
    return np.ascontiguousarray(pixels[:: -1 if down < 0 else 1, :: -1 if across < 0 else 1])


def _boxes(file: IO[bytes], size: int) -> Iterator[tuple[bytes, int]]:
    """Yields the names of the boxes at the top of an MP4 file, and where each one ends."""
    position = 0
    while position + 8 <= size:
        file.seek(position)
        header = file.read(16)
        length = int.from_bytes(header[:4])
        if length == 1:
            length = int.from_bytes(header[8:16])
        position = size if length == 0 else position + length
        if length and length < 8:
            return
        yield header[4:8], position
