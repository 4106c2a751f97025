"""Signals to a service that is under attack. It must end in time, whatever its clients do."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from collections.abc import Mapping
from functools import partial
from typing import Final

from attack import connections, heads, memory, never_read, not_frames
from attack.costly import saturate
from attack.definition import Attack, Run, UnexpectedError
from attack.images import road_jpeg
from attack.target import Target
from attack.wire import Stream

SETTINGS: Final = {"drain_s": 3}
# The service may take so long beyond the time for its drain.
_MARGIN_S: Final = 2.0
# Signals arrive so long before the end of the attack.
_BEFORE_END_S: Final = 1.0
_LONGEST_S: Final = 20.0
_BETWEEN_SIGNALS_S: Final = 0.2


async def stop_during(clients: Mapping[Run, int], target: Target, stop_at: float, _: int) -> None:
    """Sends SIGTERM while `clients`, attacks and how many connections each has, go on."""
    attacks = [asyncio.create_task(run(target, stop_at + 2 * _LONGEST_S, count)) for run, count in clients.items()]
    await asyncio.sleep(stop_at - _BEFORE_END_S - time.monotonic())
    try:
        await _stop(target, signal.SIGTERM)
    finally:
        for attack in attacks:
            attack.cancel()
        await asyncio.gather(*attacks, return_exceptions=True)


async def _hang_up(target: Target, stop_at: float, _: int) -> None:
    """Sends SIGHUP, which a closed terminal sends; streams must be told."""
    await asyncio.sleep(stop_at - _BEFORE_END_S - time.monotonic())
    async with await Stream.open(target) as stream:
        await stream.start()
        stopping = asyncio.create_task(_stop(target, signal.SIGHUP))
        try:
            message = await stream.receive_json()
        except ConnectionError as error:
            message = {"type": f"a close with {error}"}
        await stopping
    if message["type"] != "draining":
        raise UnexpectedError(f"a stream got {message['type']} instead of `draining`")


async def _interrupt_twice(target: Target, stop_at: float, count: int) -> None:
    """Sends SIGINT twice during a drain, as an impatient user does. The log must not have a traceback."""
    busy = asyncio.create_task(saturate(target, stop_at, count))
    await asyncio.sleep(stop_at - _BEFORE_END_S - time.monotonic())
    os.kill(target.pid, signal.SIGINT)
    await asyncio.sleep(_BETWEEN_SIGNALS_S)
    await _stop(target, signal.SIGINT)
    await busy


async def _stop(target: Target, number: signal.Signals) -> None:
    """Sends a signal. Raises UnexpectedError if the service does not end in time."""
    limit_s = float(target.setting("drain_s")) + _MARGIN_S
    began = time.monotonic()
    os.kill(target.pid, number)
    if not await target.ended_within(_LONGEST_S):
        raise UnexpectedError(f"{number.name} did not end the service within {_LONGEST_S:g} s")
    took = time.monotonic() - began
    if took > limit_s:
        raise UnexpectedError(f"{number.name} ended the service after {took:.1f} s, more than {limit_s:g} s")


async def _road(_: Target) -> bytes:
    return road_jpeg(1280, 720)


def _attack(name: str, description: str, run: Run) -> Attack:
    return Attack(
        f"stops/{name}", description, run, count=16, short_count=16, seconds=5.0, settings=SETTINGS, prepare=_road
    )


def _during(name: str, clients: Mapping[str, int]) -> Attack:
    runs = {_RUNS[client]: count for client, count in clients.items()}
    return _attack(name, f"SIGTERM during `{name}`", partial(stop_during, runs))


_OTHERS: Final = (heads, connections, never_read, not_frames, memory)
_RUNS: Final = {attack.name: attack.run for module in _OTHERS for attack in module.ATTACKS}

ATTACKS: Final = (
    _during("heads", {"heads/lines": 1}),
    _during("connections", {"connections/silent": 300, "connections/bodies": 300, "connections/streams": 100}),
    _during(
        "never_read",
        {"never_read/sessions": 8, "never_read/pings": 1, "never_read/pictures": 50, "never_read/documents": 1},
    ),
    _during("not_frames", {"not_frames/texts-small": 8}),
    _during("memory", {"memory/messages": 50, "memory/bodies": 50}),
    _attack("costly", "SIGTERM during `costly`", partial(stop_during, {saturate: 50})),
    _attack("hangup", "SIGHUP", _hang_up),
    _attack("interrupts", "SIGINT twice while 16 streams are busy", _interrupt_twice),
)
