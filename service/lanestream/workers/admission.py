"""Admission: which frame is processed next if there are more frames than slots."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field


@dataclass(eq=False)
class _Waiter:
    latest: bool
    admitted: asyncio.Future[None] = field(default_factory=lambda: asyncio.get_running_loop().create_future())


class FairSemaphore:
    """Admits frames to `slots`, first come, first served; at most `latest_slots` of them for frames of mode `latest`.

    A frame of mode `latest` that may not take a free slot keeps its position in the queue, so cameras of neither mode
    can starve the others. Belongs to one event loop.
    """

    def __init__(self, slots: int, latest_slots: int) -> None:
        self._slots, self._latest_slots = slots, latest_slots
        self._queue: deque[_Waiter] = deque()

    @asynccontextmanager
    async def slot(self, *, latest: bool = False) -> AsyncIterator[None]:
        """Waits for a slot and holds it for the block."""
        waiter = _Waiter(latest)
        self._queue.append(waiter)
        self._admit()
        try:
            await waiter.admitted
        except asyncio.CancelledError:
            if waiter in self._queue:
                self._queue.remove(waiter)
            else:  # admitted at the moment it was canceled
                self._release(waiter)
            raise
        try:
            yield
        finally:
            self._release(waiter)

    def _admit(self) -> None:
        """Gives the free slots to the frames that have waited longest, within the limit for mode `latest`."""
        for waiter in tuple(self._queue):
            if not self._slots:
                return
            if waiter.latest and not self._latest_slots:
                continue
            self._queue.remove(waiter)
            self._slots -= 1
            self._latest_slots -= waiter.latest
            if not waiter.admitted.done():
                waiter.admitted.set_result(None)

    def _release(self, waiter: _Waiter) -> None:
        self._slots += 1
        self._latest_slots += waiter.latest
        self._admit()
