"""Steps of the wall clock under a running service. No stream may end, and sessions must be resumed."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Final

from attack.definition import Attack, UnexpectedError
from attack.images import road_jpeg
from attack.target import Target
from attack.wire import BINARY, Stream, frame

_LIBRARIES: Final = ("/usr/lib/x86_64-linux-gnu/faketime", "/usr/lib/aarch64-linux-gnu/faketime")
_LIBRARY: Final = "libfaketimeMT.so.1"
_STEPS: Final = ("+25h", "-25h", "+0h")
_BETWEEN_S: Final = 1.0
_FILE: Final = "FAKETIME_TIMESTAMP_FILE"


@contextmanager
def _fake_clock(folder: Path) -> Iterator[Mapping[str, str]]:
    """Lets the service read its wall clock from a file. Raises UnexpectedError if faketime is not installed."""
    libraries = [path for path in (Path(each, _LIBRARY) for each in _LIBRARIES) if path.exists()]
    if not libraries:
        raise UnexpectedError("faketime is not installed (on Debian: apt install faketime)")
    file = folder / "clock"
    file.write_text("+0h\n")
    yield {
        "LD_PRELOAD": str(libraries[0]),
        _FILE: str(file),
        "FAKETIME_NO_CACHE": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
    }


async def _step(target: Target, stop_at: float, _: int) -> None:
    """Moves the clock while a stream sends frames, and resumes a session after each step."""
    image = frame(BINARY, target.payload)
    async with await Stream.open(target) as stream:
        await stream.start()
        for step in cycle(_STEPS):
            if time.monotonic() >= stop_at:
                return
            async with await Stream.open(target) as other:
                token = (await other.start())["resume_token"]
                await other.send(image)
                await other.receive_answer()
            Path(target.environment[_FILE]).write_text(f"{step}\n")
            await asyncio.sleep(_BETWEEN_S)
            try:
                await stream.send(image)
                await stream.receive_answer()
            except OSError as error:
                raise UnexpectedError(f"a stream ended after a step to {step}, with the code {error}") from None
            async with await Stream.open(target) as other:
                if not (await other.start(resume_token=token))["resumed"]:
                    raise UnexpectedError(f"a session was not resumed after a step to {step}")


async def _prepare(_: Target) -> bytes:
    return road_jpeg(320, 180)


ATTACKS: Final = (
    Attack(
        "clock/steps",
        "the wall clock moves by 25 hours, there and back",
        _step,
        surroundings=_fake_clock,
        prepare=_prepare,
    ),
)
