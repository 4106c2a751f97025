"""Admission: callers share processor time, and few frames of mode `latest` or of one caller hold slots at a time."""

from __future__ import annotations

import asyncio
from collections import Counter

from lanestream.workers.admission import FairSemaphore, Slot


class Frames:
    """Frames that wait for a slot and hold it until they leave.

    The first letter of a name is the caller; a capital means mode `latest`. The clock stands unless it is set.
    """

    def __init__(self, slots: int, latest_slots: int | None = None, per_caller: int | None = None) -> None:
        self.now = 100.0
        self.semaphore = FairSemaphore(
            slots,
            slots if latest_slots is None else latest_slots,
            slots if per_caller is None else per_caller,
            lambda: self.now,
        )
        self.holders: dict[str, Slot] = {}
        self._leaving: dict[str, asyncio.Event] = {}
        self.tasks: dict[str, asyncio.Task[None]] = {}

    async def arrive(self, *names: str) -> None:
        for name in names:
            self._leaving[name] = asyncio.Event()
            self.tasks[name] = asyncio.create_task(self._hold(name))
            await asyncio.sleep(0)
        await asyncio.sleep(0)

    async def leave(self, name: str, cost_s: float = 0.0) -> None:
        self.holders[name].cost_s = cost_s
        self._leaving[name].set()
        await self.tasks[name]
        await asyncio.sleep(0)
        await asyncio.sleep(0)

    async def _hold(self, name: str) -> None:
        async with self.semaphore.slot(name[0].lower(), latest=name.isupper()) as slot:
            self.holders[name] = slot
            await self._leaving[name].wait()
            del self.holders[name]

    def held(self) -> list[str]:
        return list(self.holders)


async def test_the_frames_of_a_caller_are_admitted_in_their_order() -> None:
    frames = Frames(2)
    await frames.arrive("a1", "a2", "a3", "a4")
    assert frames.held() == ["a1", "a2"]
    await frames.leave("a1")
    assert frames.held() == ["a2", "a3"]
    await frames.leave("a2")
    assert frames.held() == ["a3", "a4"]


async def test_few_latest_frames_hold_slots_and_the_others_keep_their_place_in_the_queue() -> None:
    frames = Frames(2, latest_slots=1)
    await frames.arrive("A1", "A2", "a3", "a4", "A5")
    assert frames.held() == ["A1", "a3"], "A2 leaves the slot to a3, and is still before a4"
    await frames.leave("A1")
    assert frames.held() == ["a3", "A2"]
    await frames.leave("a3")
    assert frames.held() == ["A2", "a4"]
    await frames.leave("A2")
    assert frames.held() == ["a4", "A5"]


async def test_a_frame_that_is_canceled_in_the_queue_leaves_no_gap() -> None:
    frames = Frames(1)
    await frames.arrive("a1", "a2", "a3")
    frames.tasks["a2"].cancel()
    await frames.leave("a1")
    assert frames.held() == ["a3"]


async def test_a_frame_that_is_canceled_as_it_is_admitted_passes_the_slot_on() -> None:
    frames = Frames(1)
    await frames.arrive("a1", "a2", "a3")
    frames._leaving["a1"].set()
    await asyncio.sleep(0)  # a1 has left, a2 is admitted and has not run yet
    frames.tasks["a2"].cancel()
    await asyncio.sleep(0.01)
    assert frames.held() == ["a3"]


async def test_a_caller_with_many_frames_leaves_others_their_share() -> None:
    frames = Frames(1)
    await frames.arrive(*(f"a{number}" for number in range(50)), "b0", "b1")
    order = []
    for _ in range(6):
        (holder,) = frames.held()
        order.append(holder)
        await frames.leave(holder, cost_s=0.02)
    assert sorted(order[1:5], key=lambda name: name[0]) == ["a1", "a2", "b0", "b1"]


async def test_callers_share_processor_time_and_not_frames() -> None:
    frames = Frames(1)
    cost = {"a": 0.3, "b": 0.01}
    used: Counter[str] = Counter()
    await frames.arrive(*(f"a{number}" for number in range(60)), *(f"b{number}" for number in range(900)))
    for _ in range(500):
        (holder,) = frames.held()
        used[holder[0]] += round(1000 * cost[holder[0]])
        await frames.leave(holder, cost[holder[0]])
    assert abs(used["a"] - used["b"]) <= 600, "milliseconds, about two of the costly frames"


async def test_time_that_a_caller_used_alone_is_not_held_against_it() -> None:
    frames = Frames(1)
    for number in range(20):
        await frames.arrive(f"a{number}")
        await frames.leave(f"a{number}", cost_s=1.0)
    await frames.arrive("c", "a20", "b0", "b1", "b2", "b3")
    order = []
    for _ in range(4):
        (holder,) = frames.held()
        order.append(holder)
        await frames.leave(holder, cost_s=0.02)
    assert "a20" in order


async def test_one_of_several_active_callers_does_not_get_every_slot() -> None:
    frames = Frames(4, per_caller=2)
    await frames.arrive("b0")
    await frames.leave("b0")
    await frames.arrive("a0", "a1", "a2", "a3")
    assert frames.held() == ["a0", "a1"], "b was active a moment ago"
    await frames.arrive("b1")
    assert frames.held() == ["a0", "a1", "b1"]
    await frames.leave("b1")
    frames.now += 10.0
    await frames.leave("a0")
    assert frames.held() == ["a1", "a2", "a3"], "b is gone"


async def test_accounts_of_idle_callers_are_forgotten() -> None:
    frames = Frames(1)
    for number in range(100):
        name = chr(ord("a") + number)
        await frames.arrive(name)
        await frames.leave(name, cost_s=0.001)
        frames.now += 10.0
    assert len(frames.semaphore._queue._accounts) < 5
