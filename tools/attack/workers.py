"""Worker processes that are killed, or that hang, while cameras stream. Cameras must go on within seconds."""

from __future__ import annotations

import asyncio
import random
import signal
import time
from functools import partial
from typing import Final

from attack.definition import Attack, UnexpectedError
from attack.target import Target

_PERIOD_S: Final = 3.0
_WORST_S: Final = 5.0


async def _signal(number: signal.Signals, target: Target, stop_at: float, count: int) -> None:
    """Sends a signal to a worker `count` times."""
    for _ in range(count):
        workers = target.workers()
        if not workers:
            raise UnexpectedError("the service has no worker processes any more")
        random.choice(workers).send_signal(number)  # noqa: S311
        await asyncio.sleep(_PERIOD_S)
    await asyncio.sleep(stop_at - time.monotonic())


ATTACKS: Final = (
    Attack(
        "workers/killed",
        "SIGKILL for a worker, three times",
        partial(_signal, signal.SIGKILL),
        count=3,
        seconds=15.0,
        short_seconds=6.0,
        worst_s=_WORST_S,
        lockout_s=_WORST_S,
        cameras=4,
    ),
    Attack(
        "workers/stopped",
        "SIGSTOP for a worker, which then hangs",
        partial(_signal, signal.SIGSTOP),
        seconds=15.0,
        short_seconds=6.0,
        worst_s=_WORST_S,
        lockout_s=_WORST_S,
        cameras=4,
    ),
)
