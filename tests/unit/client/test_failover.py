"""Which replica a client tries next, and when, on a simulated clock."""

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
from lanestream_client.endpoint import parse_endpoints
from lanestream_client.failover import FailoverPolicy, RetryPolicy

BROKEN = ConnectionFailedError("the connection broke")
NAMES = ("a", "b", "c")


class FakeClock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def new_policy(replicas: int, clock: FakeClock | None = None, jitter: float = 1.0, **retry: float) -> FailoverPolicy:
    urls = [f"http://{name}" for name in NAMES[:replicas]]
    endpoints = parse_endpoints(urls)
    return FailoverPolicy(endpoints, RetryPolicy(**retry), 30.0, clock=clock or FakeClock(), jitter=lambda: jitter)


def connected_policy(replicas: int, clock: FakeClock | None = None, **retry: float) -> FailoverPolicy:
    policy = new_policy(replicas, clock, **retry)
    policy.connected()
    policy.progressed()
    return policy


def replica(policy: FailoverPolicy) -> str:
    return policy.endpoint.base.removeprefix("http://")


def test_each_replica_is_tried_once_before_the_first_connection() -> None:
    policy = new_policy(3)
    tried = [replica(policy)]
    while policy.pause_after(BROKEN) is not None:
        tried.append(replica(policy))
    assert tried == ["a", "b", "c"]
    assert new_policy(1).pause_after(BROKEN) is None


@pytest.mark.parametrize("error", [BROKEN, BusyError("m"), NotReadyError("m"), DrainingError("m"), IdleError("m")])
def test_temporary_errors_are_retried(error: LanestreamError) -> None:
    assert connected_policy(1).pause_after(error) == 0.0
    assert connected_policy(1, total_s=0.0).pause_after(error) is None


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
def test_permanent_errors_are_not_retried(kind: type[LanestreamError]) -> None:
    assert connected_policy(3).pause_after(kind("m")) is None


def test_the_first_round_starts_at_the_same_replica_and_has_no_pauses() -> None:
    policy = connected_policy(3)
    attempts = []
    for _ in range(4):
        pause = policy.pause_after(BROKEN)
        attempts.append((replica(policy), pause))
    assert attempts == [("a", 0.0), ("b", 0.0), ("c", 0.0), ("a", 0.1)]


def test_a_draining_replica_is_tried_last() -> None:
    policy = connected_policy(3)
    assert policy.pause_after(BROKEN, draining=True) == 0.0
    attempts = [replica(policy)]
    for _ in range(2):
        policy.pause_after(BROKEN)
        attempts.append(replica(policy))
    assert attempts == ["b", "c", "a"]


def test_after_the_next_loss_the_last_connected_replica_is_tried_first() -> None:
    policy = connected_policy(2)
    policy.pause_after(BROKEN)
    policy.pause_after(BROKEN)
    policy.connected()
    policy.progressed()
    assert replica(policy) == "b"
    policy.pause_after(BROKEN)
    assert replica(policy) == "b"


def test_pauses_double_up_to_the_maximum_and_jitter_halves_them_at_most() -> None:
    for jitter, pauses in ((1.0, [0.0, 0.1, 0.2, 0.4, 0.5, 0.5]), (0.0, [0.0, 0.05, 0.1, 0.2, 0.25, 0.25])):
        policy = new_policy(1, jitter=jitter, max_pause_s=0.5)
        policy.connected()
        assert [policy.pause_after(BROKEN) for _ in range(6)] == pytest.approx(pauses)


def test_attempts_may_take_longer_in_later_rounds() -> None:
    clock = FakeClock()
    policy = new_policy(2, clock, total_s=20.0)
    assert policy.timeout_s == 15.0, "the replicas share the timeout of the first connection"
    policy.connected()
    timeouts = []
    for _ in range(5):
        policy.pause_after(BROKEN)
        timeouts.append(policy.timeout_s)
    assert timeouts == [1.0, 1.0, 2.0, 2.0, 4.0]
    clock.now += 17.5
    assert policy.timeout_s == 2.5, "the rest of the total"


def test_the_total_counts_only_time_without_a_connection() -> None:
    clock = FakeClock()
    policy = connected_policy(1, clock, total_s=10.0)
    assert policy.pause_after(BROKEN) == 0.0
    clock.now += 6.0
    assert policy.pause_after(BROKEN) is not None
    policy.connected()
    clock.now += 1000.0
    assert policy.pause_after(BROKEN) is not None
    clock.now += 3.0
    assert policy.pause_after(BROKEN) is not None
    clock.now += 1.0
    assert policy.pause_after(BROKEN) is None


def test_a_result_resets_the_total() -> None:
    clock = FakeClock()
    policy = connected_policy(1, clock, total_s=10.0)
    for _ in range(3):
        assert policy.pause_after(BROKEN) == 0.0
        clock.now += 9.0
        policy.connected()
        policy.progressed()


def test_a_replica_whose_connections_break_immediately_is_given_up() -> None:
    clock = FakeClock()
    policy = connected_policy(1, clock)
    attempts = 0
    while (pause := policy.pause_after(BROKEN)) is not None:
        attempts += 1
        clock.now += pause
        policy.connected()
    assert 10 < attempts < 30


def test_a_source_that_is_often_idle_is_not_given_up() -> None:
    policy = connected_policy(1)
    for _ in range(50):
        assert policy.pause_after(IdleError("m")) == 0.0
        policy.connected()
