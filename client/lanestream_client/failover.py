"""Where to connect next, and when: over the replicas of a service in turn, until one is there or patience ends."""

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

# What may be better on another replica, or in a moment. After any other error the same request would fail again.
PASSING: Final = (ConnectionFailedError, BusyError, DrainingError, IdleError, NotReadyError)


@dataclass(frozen=True)
class Patience:
    """How long a lost connection is sought, in seconds: `total_s` without one, 0 for not at all.

    A round tries every replica once, the first round at once. Before each later one there is a pause of up to
    `first_s`, doubled from round to round up to `most_s`; a random part of it is left out, lest all clients of a lost
    replica come at the same moments. An attempt may take `attempt_s`, and twice as long in each round as in the one
    before, because a replica that is gone may not even refuse.
    """

    total_s: float = 30.0
    first_s: float = 0.1
    most_s: float = 2.0
    attempt_s: float = 1.0

    def pause_s(self, turn: int, chance: float) -> float:
        """The pause before round `turn`, counted from 0; `chance` in [0, 1) chooses between half of it and all."""
        return 0.0 if turn == 0 else min(self.most_s, self.first_s * 2.0 ** (turn - 1)) * (0.5 + 0.5 * chance)


class Route:
    """The way to a service, which is at one of `endpoints`. Connecting for the first time may take `timeout` seconds.

    Where no connection was made yet, each replica is tried once. Later ones begin with the replica that was connected
    last, which may be the only one that knows the session, unless it said that it leaves.
    """

    def __init__(
        self,
        endpoints: Sequence[Endpoint],
        patience: Patience,
        timeout: float,
        *,
        clock: Callable[[], float] = time.monotonic,
        chance: Callable[[], float] = random.random,
    ) -> None:
        self._endpoints = tuple(endpoints)
        self._patience = patience
        self._timeout = timeout
        self._clock = clock
        self._chance = chance
        self._at = 0
        self._attempts = 0  # since the last progress
        self._spent = 0.0  # seconds without a connection since then, but for the present ones
        self._lost_at: float | None = None
        self._was_connected = False

    @property
    def endpoint(self) -> Endpoint:
        """The replica that is connected, or that is to be tried next."""
        return self._endpoints[self._at]

    @property
    def timeout_s(self) -> float:
        """How long the next attempt may take."""
        if not self._was_connected:
            return self._timeout / len(self._endpoints)
        turn = (self._attempts - 1) // len(self._endpoints)
        return max(1e-3, min(self._timeout, self._patience.attempt_s * 2.0**turn, self._left()))

    def connected(self) -> None:
        """A replica has opened the stream."""
        if self._lost_at is not None:
            self._spent += self._clock() - self._lost_at
            self._lost_at = None
        if not self._was_connected:
            self._attempts = 0
        self._was_connected = True

    def progressed(self) -> None:
        """A frame was answered: only then is a connection more than one that is lost again for the same reason."""
        self._attempts = 0
        self._spent = 0.0

    def after(self, error: LanestreamError, *, leaving: bool = False) -> float | None:
        """Seconds to wait before the next attempt after `error`; None where there is to be none.

        `leaving` where the replica had said that it is about to stop.
        """
        if not isinstance(error, PASSING):
            return None
        if isinstance(error, IdleError):
            self.progressed()
        failed_attempt = not self._was_connected or self._lost_at is not None
        if failed_attempt or leaving:
            self._at = (self._at + 1) % len(self._endpoints)
        turn, place = divmod(self._attempts, len(self._endpoints))
        self._attempts += 1
        if not self._was_connected:
            return 0.0 if self._attempts < len(self._endpoints) else None
        if self._lost_at is None:
            self._lost_at = self._clock()
        pause = 0.0 if place else self._patience.pause_s(turn, self._chance())
        return pause if pause < self._left() else None

    def _left(self) -> float:
        gone = 0.0 if self._lost_at is None else self._clock() - self._lost_at
        return self._patience.total_s - self._spent - gone
