"""Turns: work of an address begins at a limited rate, and its connections take turns.

So one connection that sends as fast as it can does not keep the other ones of its address waiting.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable

from lanestream.streaming.token_bucket import TokenBucket, TokenBuckets


class Turns:
    """Lets work of each address begin `per_s` times a second on average, and `per_s * burst_s` times at once.

    `clock` returns monotonic seconds.
    """

    def __init__(self, per_s: float, burst_s: float, clock: Callable[[], float]) -> None:
        self._buckets = TokenBuckets(per_s, burst_s)
        self._waiting: dict[str, deque[Callable[[], None]]] = {}
        self._clock = clock

    def begin(self, address: str, proceed: Callable[[], None]) -> bool:
        """Returns whether work may begin now. If not, `proceed` is called as soon as it may."""
        bucket = self._bucket(address)
        if address not in self._waiting and bucket.covers(1.0, self._clock()):
            bucket.spend(1.0)
            return True
        if address not in self._waiting:
            self._waiting[address] = deque()
            self._schedule(address)
        self._waiting[address].append(proceed)
        return False

    def count(self, address: str) -> None:
        """Counts work that has begun without `begin`."""
        self._bucket(address).spend(1.0)

    def _bucket(self, address: str) -> TokenBucket:
        return self._buckets.bucket(address, self._clock())

    def _schedule(self, address: str) -> None:
        wait_s = self._bucket(address).seconds_until(1.0, self._clock())
        asyncio.get_running_loop().call_later(wait_s, self._next, address)

    def _next(self, address: str) -> None:
        waiting, bucket = self._waiting[address], self._bucket(address)
        while waiting and bucket.covers(1.0, self._clock()):
            bucket.spend(1.0)
            waiting.popleft()()
        if waiting:
            self._schedule(address)
        else:
            del self._waiting[address]
