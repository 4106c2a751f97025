"""Admission: which frame is worked on next, when there are more than there are threads."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field


@dataclass(eq=False)
class _Waiting:
    fresh: bool
    called: asyncio.Future[None] = field(default_factory=lambda: asyncio.get_running_loop().create_future())


class Admission:
    """`places` among the frames in work, first come, first served; at most `fresh` of them for frames wanted fresh.

    A frame wanted fresh that has to leave the places to others keeps its place in the line: where cameras of both kinds
    wait, none of them waits for longer than the others' frames take. Belongs to one event loop.
    """

    def __init__(self, places: int, fresh: int) -> None:
        self._places, self._fresh = places, fresh
        self._line: deque[_Waiting] = deque()

    @asynccontextmanager
    async def turn(self, *, fresh: bool = False) -> AsyncIterator[None]:
        """Waits for a place, and has it for the block."""
        waiting = _Waiting(fresh)
        self._line.append(waiting)
        self._call()
        try:
            await waiting.called
        except asyncio.CancelledError:
            if waiting in self._line:
                self._line.remove(waiting)
            else:  # called in the very moment in which it gave up
                self._leave(waiting)
            raise
        try:
            yield
        finally:
            self._leave(waiting)

    def _call(self) -> None:
        """Gives the free places to those who have waited longest and may have them."""
        for waiting in tuple(self._line):
            if not self._places:
                return
            if waiting.fresh and not self._fresh:
                continue
            self._line.remove(waiting)
            self._places -= 1
            self._fresh -= waiting.fresh
            if not waiting.called.done():
                waiting.called.set_result(None)

    def _leave(self, waiting: _Waiting) -> None:
        self._places += 1
        self._fresh += waiting.fresh
        self._call()
