"""Who is next: first come, first served, and few of those who want their frames fresh at a time."""

from __future__ import annotations

import asyncio

from lanestream.workers.admission import Admission


class Line:
    """Frames with names that come for a turn, and keep it until they are let go."""

    def __init__(self, places: int, fresh: int) -> None:
        self.turns = Admission(places, fresh)
        self.working: list[str] = []
        self.tasks: dict[str, asyncio.Task[None]] = {}

    async def come(self, *names: str) -> None:
        """Names in capitals want to be fresh."""
        for name in names:
            self.tasks[name] = asyncio.create_task(self._work(name))
            await asyncio.sleep(0)
        await asyncio.sleep(0)

    async def go(self, name: str) -> None:
        self.tasks[name].cancel()
        await asyncio.wait([self.tasks[name]])
        await asyncio.sleep(0)

    async def _work(self, name: str) -> None:
        async with self.turns.turn(fresh=name.isupper()):
            self.working.append(name)
            try:
                await asyncio.Event().wait()
            finally:
                self.working.remove(name)


def test_turns_are_had_in_the_order_of_coming() -> None:
    async def run() -> None:
        line = Line(2, fresh=1)
        await line.come("a", "b", "c", "d")
        assert line.working == ["a", "b"]
        await line.go("a")
        assert line.working == ["b", "c"]
        await line.go("b")
        assert line.working == ["c", "d"]

    asyncio.run(run())


def test_few_frames_are_fresh_at_a_time_and_the_others_keep_their_place() -> None:
    async def run() -> None:
        line = Line(2, fresh=1)
        await line.come("A", "B", "c", "d", "E")
        assert line.working == ["A", "c"]  # B leaves its place to c, and is still before d
        await line.go("A")
        assert line.working == ["c", "B"]
        await line.go("c")
        assert line.working == ["B", "d"]
        await line.go("B")
        assert line.working == ["d", "E"]

    asyncio.run(run())


def test_who_gives_up_waiting_leaves_no_gap() -> None:
    async def run() -> None:
        line = Line(1, fresh=1)
        await line.come("a", "b", "c")
        await line.go("b")
        await line.go("a")
        assert line.working == ["c"]
        await line.go("c")
        await line.come("D")
        assert line.working == ["D"]

    asyncio.run(run())


def test_who_gives_up_as_he_is_called_gives_the_place_on() -> None:
    async def run() -> None:
        line = Line(1, fresh=1)
        await line.come("a", "b", "c")
        line.tasks["a"].cancel()
        await asyncio.sleep(0)  # a has left, b is called and does not know it yet
        line.tasks["b"].cancel()
        await asyncio.sleep(0.01)
        assert line.working == ["c"]

    asyncio.run(run())
