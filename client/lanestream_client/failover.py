"""Decides which replica of a service a stream tries next, when, and when it gives up."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from lanestream.errors import (
    BusyError,
    ConnectionFailedError,
    DrainingError,
    IdleError,
    LanestreamError,
    NotReadyError,
)
from lanestream_client.endpoint import Endpoint

# Another replica or a later attempt may not have these errors. Any other would come again for the same request.
RETRYABLE: Final = (ConnectionFailedError, BusyError, DrainingError, IdleError, NotReadyError)


@dataclass(frozen=True)
class RetryPolicy:
    """How long to keep trying after a connection was lost, in seconds.

    A stream gives up after `total_s` without a connection; 0 disables retries. One round tries every replica once. The
    first round starts immediately; before each later one there is a pause of up to `first_pause_s`, doubled each round
    up to `max_pause_s`. The pause is shortened by a random amount, so that the clients of a lost replica do not all
    reconnect at the same moment. An attempt may take `attempt_s` in the first round and twice as long in each later
    one, because a replica that is gone may not even refuse the connection.
    """

    total_s: float = 30.0
    first_pause_s: float = 0.1
    max_pause_s: float = 2.0
    attempt_s: float = 1.0

    def pause_s(self, round_number: int, jitter: float) -> float:
        """Returns the pause before a round, counted from 0. `jitter` in [0, 1) scales it from half to full length."""
        if round_number == 0:
            return 0.0
        return min(self.max_pause_s, self.first_pause_s * 2.0 ** (round_number - 1)) * (0.5 + 0.5 * jitter)


class FailoverPolicy:
    """Chooses among the replicas at `endpoints`. The first connection may take `timeout` seconds in all.

    Before the first connection, each replica is tried once. After a connection was lost, the first attempt goes to the
    same replica, which may be the only one that has the session, unless it announced that it is draining.
    """

    def __init__(
        self,
        endpoints: Sequence[Endpoint],
        retry: RetryPolicy,
        timeout: float,
        *,
        clock: Callable[[], float] = time.monotonic,
        jitter: Callable[[], float] = random.random,
    ) -> None:
        self._endpoints = tuple(endpoints)
        self._retry = retry
        self._timeout = timeout
        self._clock = clock
        self._jitter = jitter
        self._index = 0
        self._attempts = 0  # since the last progress
        self._past_outages_s = 0.0  # time without a connection since the last progress, the present outage excluded
        self._outage_started: float | None = None
        self._was_connected = False

    @property
    def endpoint(self) -> Endpoint:
        """The replica that is connected, or that will be tried next."""
        return self._endpoints[self._index]

    @property
    def timeout_s(self) -> float:
        """How long the next attempt may take, in seconds."""
        if not self._was_connected:
            return self._timeout / len(self._endpoints)
        round_number = (self._attempts - 1) // len(self._endpoints)
        return max(1e-3, min(self._timeout, self._retry.attempt_s * 2.0**round_number, self._remaining_s()))

    def connected(self) -> None:
        """Records that a replica has opened the stream."""
        if self._outage_started is not None:
            self._past_outages_s += self._clock() - self._outage_started
            self._outage_started = None
        if not self._was_connected:
            self._attempts = 0
        self._was_connected = True

    def progressed(self) -> None:
        """Records that a frame got its result, and resets the time and the attempts that retries may use.

        Connecting alone does not reset them: the connection may be lost again for the same reason.
        """
        self._attempts = 0
        self._past_outages_s = 0.0

    def pause_after(self, error: LanestreamError, *, draining: bool = False) -> float | None:
        """Returns the seconds to wait before the next attempt after `error`, or None if the stream should give up.

        `draining` says whether the replica had announced that it is about to stop.
        """
        if not isinstance(error, RETRYABLE):
            return None
        if isinstance(error, IdleError):
            self.progressed()
        attempt_failed = not self._was_connected or self._outage_started is not None
        if attempt_failed or draining:
            self._index = (self._index + 1) % len(self._endpoints)
        round_number, attempt_in_round = divmod(self._attempts, len(self._endpoints))
        self._attempts += 1
        if not self._was_connected:
            return 0.0 if self._attempts < len(self._endpoints) else None
        if self._outage_started is None:
            self._outage_started = self._clock()
        pause = 0.0 if attempt_in_round else self._retry.pause_s(round_number, self._jitter())
        return pause if pause < self._remaining_s() else None

    def _remaining_s(self) -> float:
        outage_s = 0.0 if self._outage_started is None else self._clock() - self._outage_started
        return self._retry.total_s - self._past_outages_s - outage_s
