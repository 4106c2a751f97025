"""Where a client connects next, and when, on a clock of the test's own."""

from __future__ import annotations

import pytest

from lanestream.errors import (
    BusyError,
    ConnectionFailedError,
    DrainingError,
    EvictedError,
    ForbiddenError,
    IdleError,
    LanestreamError,
    NoDetectorError,
    NotReadyError,
    OverrunError,
    ProtocolError,
    TooOldError,
    UnauthorizedError,
)
from lanestream_client.endpoint import endpoints
from lanestream_client.failover import Patience, Route

BROKEN = ConnectionFailedError("the connection broke")
NAMES = ("a", "b", "c")


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def route(replicas: int, clock: Clock | None = None, chance: float = 1.0, **patience: float) -> Route:
    urls = [f"http://{name}" for name in NAMES[:replicas]]
    return Route(endpoints(urls), Patience(**patience), 30.0, clock=clock or Clock(), chance=lambda: chance)


def connected(replicas: int, clock: Clock | None = None, **patience: float) -> Route:
    way = route(replicas, clock, **patience)
    way.connected()
    way.progressed()
    return way


def place(way: Route) -> str:
    return way.endpoint.base.removeprefix("http://")


def test_at_first_each_replica_is_tried_once() -> None:
    way = route(3)
    tried = [place(way)]
    while way.after(BROKEN) is not None:
        tried.append(place(way))
    assert tried == ["a", "b", "c"]
    assert route(1).after(BROKEN) is None


@pytest.mark.parametrize("error", [BROKEN, BusyError("m"), NotReadyError("m"), DrainingError("m"), IdleError("m")])
def test_what_passes_is_worth_another_attempt(error: LanestreamError) -> None:
    assert connected(1).after(error) == 0.0
    assert connected(1, total_s=0.0).after(error) is None


@pytest.mark.parametrize(
    "kind",
    [
        EvictedError,
        UnauthorizedError,
        ForbiddenError,
        ProtocolError,
        OverrunError,
        NoDetectorError,
        TooOldError,
        LanestreamError,
    ],
)
def test_what_would_come_again_is_not(kind: type[LanestreamError]) -> None:
    assert connected(3).after(kind("m")) is None


def test_a_lost_connection_is_sought_where_it_was_and_then_all_around_without_a_pause() -> None:
    way = connected(3)
    visits = []
    for _ in range(4):
        pause = way.after(BROKEN)
        visits.append((place(way), pause))
    assert visits == [("a", 0.0), ("b", 0.0), ("c", 0.0), ("a", 0.1)]


def test_a_replica_that_said_it_leaves_comes_last() -> None:
    way = connected(3)
    assert way.after(BROKEN, leaving=True) == 0.0
    visits = [place(way)]
    for _ in range(2):
        way.after(BROKEN)
        visits.append(place(way))
    assert visits == ["b", "c", "a"]


def test_the_next_loss_begins_at_the_replica_of_the_last_connection() -> None:
    way = connected(2)
    way.after(BROKEN)
    way.after(BROKEN)
    way.connected()
    way.progressed()
    assert place(way) == "b"
    way.after(BROKEN)
    assert place(way) == "b"


def test_pauses_double_up_to_the_most_and_keep_half_by_chance() -> None:
    for chance, pauses in ((1.0, [0.0, 0.1, 0.2, 0.4, 0.5, 0.5]), (0.0, [0.0, 0.05, 0.1, 0.2, 0.25, 0.25])):
        way = route(1, chance=chance, most_s=0.5)
        way.connected()
        assert [way.after(BROKEN) for _ in range(6)] == pytest.approx(pauses)


def test_attempts_may_take_longer_from_round_to_round() -> None:
    clock = Clock()
    way = route(2, clock, total_s=20.0)
    assert way.timeout_s == 15.0, "the first time the replicas share what there is"
    way.connected()
    times = []
    for _ in range(5):
        way.after(BROKEN)
        times.append(way.timeout_s)
    assert times == [1.0, 1.0, 2.0, 2.0, 4.0]
    clock.now += 17.5
    assert way.timeout_s == 2.5, "what is left"


def test_patience_counts_the_time_without_a_connection() -> None:
    clock = Clock()
    way = connected(1, clock, total_s=10.0)
    assert way.after(BROKEN) == 0.0
    clock.now += 6.0
    assert way.after(BROKEN) is not None
    way.connected()
    clock.now += 1000.0
    assert way.after(BROKEN) is not None
    clock.now += 3.0
    assert way.after(BROKEN) is not None
    clock.now += 1.0
    assert way.after(BROKEN) is None


def test_only_an_answer_renews_it() -> None:
    clock = Clock()
    way = connected(1, clock, total_s=10.0)
    for _ in range(3):
        assert way.after(BROKEN) == 0.0
        clock.now += 9.0
        way.connected()
        way.progressed()


def test_a_replica_that_breaks_at_once_each_time_is_left_in_the_end() -> None:
    clock = Clock()
    way = connected(1, clock)
    attempts = 0
    while (pause := way.after(BROKEN)) is not None:
        attempts += 1
        clock.now += pause
        way.connected()
    assert 10 < attempts < 30


def test_a_source_that_is_often_silent_is_no_reason_to_give_up() -> None:
    way = connected(1)
    for _ in range(50):
        assert way.after(IdleError("m")) == 0.0
        way.connected()
