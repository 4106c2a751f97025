"""Admission: which frame is processed next if there are more frames than slots.

Callers share the processors, not the queue: of the callers with waiting frames, the one that has used the least
processor time goes first, so that neither many sessions nor costly images take more than a share. The method is
start-time fair queueing (Goyal, Vin and Cheng, SIGCOMM 1996), with costs that are known only afterwards.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Final

# A caller counts as active for this long after its last frame.
_ACTIVE_S: Final = 1.0
# The weight of a frame's cost in the mean by which the next one is estimated, and the estimate for a new caller.
_GAIN: Final = 0.25
_FIRST_COST_S: Final = 0.02
# What every frame costs besides: receiving it, handing it over and answering, even if its image is refused.
_OVERHEAD_S: Final = 0.002


@dataclass(eq=False)
class Slot:
    """A frame's permission to be processed; what it is expected to cost, and has cost, in seconds of processor time."""

    expected_s: float = _FIRST_COST_S
    cost_s: float = _OVERHEAD_S

    def charge(self, seconds: float) -> None:
        """Adds processor time to the caller's account."""
        self.cost_s += seconds


@dataclass(eq=False)
class Waiter:
    """A frame that waits for a slot or holds one. `admit` is called once, when it gets the slot."""

    caller: str
    latest: bool
    admit: Callable[[], None]
    slot: Slot = field(default_factory=Slot)


@dataclass(eq=False)
class _Account:
    """A caller's waiting frames, the slots it holds, and its processor time on the clock that all callers share."""

    used_s: float
    active_at: float
    mean_cost_s: float = _FIRST_COST_S
    held: int = 0
    queue: deque[Waiter] = field(default_factory=deque)


class FairQueue:
    """The rules of admission, without waiting: at most `latest_slots` of the `slots` are for frames of mode `latest`.

    A caller that has used more than another active one may hold `per_caller` slots: a frame is never interrupted, so
    costly ones must not occupy every processor. The frames of one caller are admitted in their order, except that one
    of mode `latest` that may not take a free slot keeps its position. `clock` returns monotonic seconds.
    """

    def __init__(self, slots: int, latest_slots: int, per_caller: int, clock: Callable[[], float]) -> None:
        self._slots, self._latest_slots, self._per_caller = slots, latest_slots, per_caller
        self._clock = clock
        self._accounts: dict[str, _Account] = {}
        # The time used by the caller that was admitted last. A caller that was idle begins here: it has no arrears,
        # and what it used while no one else wanted it is not held against it.
        self._virtual_s = 0.0

    def enter(self, caller: str, admit: Callable[[], None], *, latest: bool = False) -> Waiter:
        """Adds a frame, which may get a slot at once, and calls `admit` when it does."""
        account = self._accounts.setdefault(caller, _Account(self._virtual_s, self._clock()))
        if not account.queue and not account.held:
            account.used_s = max(account.used_s, self._virtual_s)
        account.active_at = self._clock()
        waiter = Waiter(caller, latest, admit)
        account.queue.append(waiter)
        self._admit()
        return waiter

    def leave(self, waiter: Waiter) -> None:
        """Removes a frame, and gives its slot to the next one if it holds one."""
        account = self._accounts[waiter.caller]
        if waiter in account.queue:
            account.queue.remove(waiter)
        else:
            self._release(account, waiter)

    def _admit(self) -> None:
        """Gives the free slots away, each to the caller that has used the least time of those that may take it."""
        while self._slots:
            waiting = sorted((each for each in self._accounts.values() if each.queue), key=lambda each: each.used_s)
            if not any(self._take_slot(account) for account in waiting):
                return

    def _take_slot(self, account: _Account) -> bool:
        """Gives a slot to the first frame of a caller that may take one. Returns False if none may."""
        if account.held >= self._per_caller and self._has_used_more(account):
            return False
        waiter = next((each for each in account.queue if self._latest_slots or not each.latest), None)
        if waiter is None:
            return False
        account.queue.remove(waiter)
        self._slots -= 1
        self._latest_slots -= waiter.latest
        self._virtual_s = max(self._virtual_s, account.used_s)
        # Charged now, so that several free slots do not all go to one caller; corrected when the cost is known.
        waiter.slot.expected_s = account.mean_cost_s
        account.used_s += waiter.slot.expected_s
        account.held += 1
        waiter.admit()
        return True

    def _has_used_more(self, account: _Account) -> bool:
        """Returns whether another caller is active and has used less."""
        since = self._clock() - _ACTIVE_S
        return any(
            other.used_s < account.used_s and (other.queue or other.held or other.active_at > since)
            for other in self._accounts.values()
        )

    def _release(self, account: _Account, waiter: Waiter) -> None:
        slot = waiter.slot
        self._slots += 1
        self._latest_slots += waiter.latest
        account.held -= 1
        account.used_s += slot.cost_s - slot.expected_s
        account.mean_cost_s += _GAIN * (slot.cost_s - account.mean_cost_s)
        account.active_at = self._clock()
        self._settle()
        self._admit()

    def _settle(self) -> None:
        """Ends all arrears if no frame is left, and deletes the accounts of idle callers that have none."""
        if not any(each.queue or each.held for each in self._accounts.values()):
            self._virtual_s = max(each.used_s for each in self._accounts.values())
        since = self._clock() - _ACTIVE_S
        idle = [
            caller
            for caller, each in self._accounts.items()
            if not each.queue and not each.held and each.active_at <= since and each.used_s <= self._virtual_s
        ]
        for caller in idle:
            del self._accounts[caller]


class FairSemaphore:
    """A `FairQueue` for the tasks of one event loop."""

    def __init__(
        self, slots: int, latest_slots: int, per_caller: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._queue = FairQueue(slots, latest_slots, per_caller, clock)

    @asynccontextmanager
    async def slot(self, caller: str, *, latest: bool = False) -> AsyncIterator[Slot]:
        """Waits for a slot and holds it for the block."""
        admitted = asyncio.Event()
        waiter = self._queue.enter(caller, admitted.set, latest=latest)
        try:
            await admitted.wait()
            yield waiter.slot
        finally:
            self._queue.leave(waiter)
