"""Admission: first come, first served, and only a few frames of mode `latest` at a time."""

from __future__ import annotations

import asyncio

from lanestream.workers.admission import FairSemaphore


class Frames:
    """Frames with one-letter names that wait for a slot and hold it until they leave; capitals are of mode `latest`."""

    def __init__(self, slots: int, latest_slots: int) -> None:
        self.semaphore = FairSemaphore(slots, latest_slots)
        self.holders: list[str] = []
        self.tasks: dict[str, asyncio.Task[None]] = {}

    async def arrive(self, *names: str) -> None:
        for name in names:
            self.tasks[name] = asyncio.create_task(self._hold(name))
            await asyncio.sleep(0)
        await asyncio.sleep(0)

    async def leave(self, name: str) -> None:
        self.tasks[name].cancel()
        await asyncio.wait([self.tasks[name]])
        await asyncio.sleep(0)

    async def _hold(self, name: str) -> None:
        async with self.semaphore.slot(latest=name.isupper()):
            self.holders.append(name)
            try:
                await asyncio.Event().wait()
            finally:
                self.holders.remove(name)


async def test_slots_are_given_in_the_order_of_arrival() -> None:
    frames = Frames(2, latest_slots=1)
    await frames.arrive("a", "b", "c", "d")
    assert frames.holders == ["a", "b"]
    await frames.leave("a")
    assert frames.holders == ["b", "c"]
    await frames.leave("b")
    assert frames.holders == ["c", "d"]


async def test_few_latest_frames_hold_slots_and_the_others_keep_their_place_in_the_queue() -> None:
    frames = Frames(2, latest_slots=1)
    await frames.arrive("A", "B", "c", "d", "E")
    assert frames.holders == ["A", "c"], "B leaves the slot to c, and is still before d"
    await frames.leave("A")
    assert frames.holders == ["c", "B"]
    await frames.leave("c")
    assert frames.holders == ["B", "d"]
    await frames.leave("B")
    assert frames.holders == ["d", "E"]


async def test_a_frame_that_is_canceled_in_the_queue_leaves_no_gap() -> None:
    frames = Frames(1, latest_slots=1)
    await frames.arrive("a", "b", "c")
    await frames.leave("b")
    await frames.leave("a")
    assert frames.holders == ["c"]
    await frames.leave("c")
    await frames.arrive("D")
    assert frames.holders == ["D"]


async def test_a_frame_that_is_canceled_as_it_is_admitted_passes_the_slot_on() -> None:
    frames = Frames(1, latest_slots=1)
    await frames.arrive("a", "b", "c")
    frames.tasks["a"].cancel()
    await asyncio.sleep(0)  # a has left, b is admitted and has not run yet
    frames.tasks["b"].cancel()
    await asyncio.sleep(0.01)
    assert frames.holders == ["c"]
