"""Images that cost as much as the service accepts, and ordinary ones as fast as it takes them, by one caller.

Seven normal cameras of another caller must keep most of the answers that they get alone.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import Final

from attack.clients import repeat
from attack.definition import Attack, Prepare, Run
from attack.images import LARGEST, deep_png, lossless_webp, png, progressive_jpeg, road_jpeg
from attack.target import Target
from attack.wire import BINARY, Connection, Stream, frame, request

_SIZE: Final = (1280, 720)
_CAMERAS: Final = 7
_SCANS: Final = (100, 50, 20, 10, 5, 2)
_EXCESS_MB: Final = (1000, 256, 64, 16, 4)
_STREAMS: Final = (1, 8, 50)
_REQUESTS: Final = 16
_OK: Final = 200
# The service may take so long for one image while it is still idle.
_IMAGE_S: Final = 20.0

Images = Callable[[], Sequence[bytes]]


async def saturate(target: Target, stop_at: float, count: int) -> None:
    """Streams in mode `all` that always use all their credits."""
    image = frame(BINARY, target.payload)

    async def use(stream: Stream) -> None:
        ready = await stream.start(mode="all")
        for _ in range(ready["limits"]["credits"]):
            await stream.send(image)
        while True:
            await stream.receive_answer()
            await stream.send(image)

    await repeat(partial(Stream.open, target), use, stop_at, count)


async def _request_pictures(target: Target, stop_at: float, count: int) -> None:
    """Requests for annotated pictures, one after the other over each connection."""

    async def use(connection: Connection) -> None:
        while True:
            await connection.send(_detect(target, target.payload))
            await connection.response()

    await repeat(partial(Connection.open, target), use, stop_at, count)


async def _costliest(images: Images, target: Target) -> bytes:
    """Returns the image that takes the service the longest, the last one if it accepts none."""
    times = {image: await _time(image, target) for image in images()}
    return max(reversed(times), key=lambda image: times[image])


async def _time(image: bytes, target: Target) -> float:
    """Returns the seconds that the service takes for an image, 0 if it refuses it."""
    began = time.monotonic()
    with suppress(OSError, TimeoutError):
        async with asyncio.timeout(_IMAGE_S), await Connection.open(target) as connection:
            await connection.send(_detect(target, image))
            status, _ = await connection.response()
            return time.monotonic() - began if status == _OK else 0.0
    return 0.0


def _detect(target: Target, image: bytes) -> bytes:
    return request("POST", "/v1/detect", ("Accept", "image/png"), key=target.attacker_key, body=image)


def _pngs() -> Sequence[bytes]:
    return [*(png(*_SIZE, excess) for excess in _EXCESS_MB), deep_png(*LARGEST), png(*LARGEST), png(*_SIZE)]


# By their names: what they are, and candidates, of which the costliest accepted one is taken.
_IMAGES: Final[dict[str, tuple[str, Images]]] = {
    "jpeg": ("JPEGs of many scans", lambda: [progressive_jpeg(*_SIZE, scans) for scans in _SCANS]),
    "jpeg-4k": ("JPEGs of many scans, 4096 x 2304", lambda: [progressive_jpeg(*LARGEST, scans) for scans in _SCANS]),
    "png": ("PNGs that inflate a thousandfold", _pngs),
    "webp": ("lossless WebPs, 4096 x 2304", lambda: [lossless_webp(*LARGEST)]),
    "frames": ("ordinary frames", lambda: [road_jpeg(*_SIZE)]),
}


def _attacks() -> Iterator[Attack]:
    for name, (description, images) in _IMAGES.items():
        prepare = partial(_costliest, images)
        for count in _STREAMS:
            streams = "1 stream" if count == 1 else f"{count} streams"
            yield _attack(f"{name}-{count}", f"{description}, {streams}", saturate, prepare, count)
        yield _attack(
            f"{name}-pictures", f"{description}, requests for pictures", _request_pictures, prepare, _REQUESTS
        )


def _attack(name: str, description: str, run: Run, prepare: Prepare, count: int) -> Attack:
    return Attack(
        f"costly/{name}",
        description,
        run,
        count=count,
        short_count=count,
        prepare=prepare,
        cameras=_CAMERAS,
        fair=True,
    )


ATTACKS: Final = tuple(_attacks())
