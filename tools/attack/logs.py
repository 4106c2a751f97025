"""A log that nobody reads: a pipe that is full, as of a stuck log collector."""

from __future__ import annotations

from functools import partial
from typing import Final

from attack.clients import repeat
from attack.definition import Attack
from attack.not_frames import not_found
from attack.stops import SETTINGS, stop_during
from attack.target import Target
from attack.wire import Stream


async def _short_streams(target: Target, stop_at: float, count: int) -> None:
    """Streams that are opened and closed at once; the service logs each."""
    await repeat(partial(Stream.open, target), Stream.start, stop_at, count, pause_s=0.0)


ATTACKS: Final = (
    Attack(
        "logs/unread",
        "what is logged fills a pipe that nobody reads, then SIGTERM",
        partial(stop_during, {_short_streams: 4, not_found: 4}),
        settings=SETTINGS,
        unread_log=True,
    ),
)
