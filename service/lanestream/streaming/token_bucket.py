"""Rate limits: token buckets, single or one for each of many names."""

from __future__ import annotations

from typing import Final

# Beyond this number of names, those whose bucket is full are forgotten, then the oldest ones.
_MOST_NAMES: Final = 4096


class TokenBucket:
    """Limits a rate: `rate` units per second on average, with bursts of `burst_s` seconds' worth.

    `now` is always a time on one monotonic clock, in seconds.
    """

    def __init__(self, rate: float, burst_s: float, now: float) -> None:
        self._rate = rate
        self._capacity = max(rate * burst_s, 1.0)
        self._tokens = self._capacity
        self._updated_at = now

    def covers(self, amount: float, now: float) -> bool:
        """Returns whether `amount` is available. An amount above the capacity needs a full bucket."""
        self._refill(now)
        return self._tokens >= min(amount, self._capacity)

    def spend(self, amount: float) -> None:
        """Removes `amount`; the level may become negative."""
        self._tokens -= amount

    def seconds_until(self, amount: float, now: float) -> float:
        """Returns how long to wait until `amount` is available, 0 if it is."""
        self._refill(now)
        return max(0.0, min(amount, self._capacity) - self._tokens) / self._rate

    def is_full(self, now: float) -> bool:
        """Returns whether nothing was spent that has not been refilled."""
        self._refill(now)
        return self._tokens >= self._capacity

    def _refill(self, now: float) -> None:
        self._tokens = min(self._capacity, self._tokens + self._rate * (now - self._updated_at))
        self._updated_at = now


class TokenBuckets:
    """Token buckets by name, of callers or addresses. The number of names that are kept is bounded."""

    def __init__(self, rate: float, burst_s: float) -> None:
        self._rate, self._burst_s = rate, burst_s
        self._buckets: dict[str, TokenBucket] = {}

    def bucket(self, name: str, now: float) -> TokenBucket:
        """Returns the bucket of `name`, a full one for a new name."""
        bucket = self._buckets.get(name)
        if bucket is None:
            if len(self._buckets) >= _MOST_NAMES:
                self._forget(now)
            bucket = self._buckets[name] = TokenBucket(self._rate, self._burst_s, now)
        return bucket

    def _forget(self, now: float) -> None:
        self._buckets = {name: bucket for name, bucket in self._buckets.items() if not bucket.is_full(now)}
        for name in tuple(self._buckets)[: len(self._buckets) - _MOST_NAMES // 2]:
            del self._buckets[name]
