from __future__ import annotations

import asyncio
import warnings
from typing import Any

import pytest
from prometheus_client import CollectorRegistry, Counter, Histogram

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    ray_exceptions = pytest.importorskip("ray.exceptions", reason="needs Ray: use `make ray-test`")
    from lanestream.cluster import metrics, replica
    from lanestream.cluster.replica import PeerLoss, StreamMover

pytestmark = pytest.mark.filterwarnings("ignore")


class FakeService:
    """Records what it is asked to do."""

    def __init__(self, streams: int) -> None:
        self.streams = set(range(streams))
        self.draining = False
        self.drains = 0

    def hand_over(self, count: int) -> int:
        self.streams = set(list(self.streams)[count:])
        return count

    async def drain(self) -> None:
        self.draining = True
        self.drains += 1


@pytest.fixture
def service(monkeypatch: pytest.MonkeyPatch) -> FakeService:
    monkeypatch.setattr(replica, "SETTLE_S", 0.0)
    monkeypatch.setattr(replica, "_RETRY_S", 0.0)
    return FakeService(12)


class Controller:
    """Says whether it is stopping the replica."""

    stopping = True

    async def is_stopping(self) -> bool:
        return self.stopping


async def update(mover: StreamMover, *names: str) -> None:
    mover.update(names)
    for _ in range(5):
        await asyncio.sleep(0)


async def test_streams_are_shared_with_new_replicas(service: Any) -> None:
    mover = StreamMover(service, "a", Controller().is_stopping)
    await update(mover)  # it is not ready yet
    await update(mover, "a", "b")  # it is the new one
    assert len(service.streams) == 12
    await update(mover, "a", "b", "c")
    assert len(service.streams) == 8
    await update(mover, "a", "c")
    assert len(service.streams) == 8
    await update(mover, "a", "c", "d", "e")
    assert len(service.streams) == 4
    assert not service.draining


async def test_a_replica_that_is_removed_drains(service: Any) -> None:
    mover = StreamMover(service, "a", Controller().is_stopping)
    await update(mover, "a", "b")
    await update(mover, "b")
    assert (service.draining, service.drains) == (True, 1)
    await update(mover, "b", "c")
    assert service.drains == 1


async def test_a_controller_that_restarts_moves_no_stream(service: Any) -> None:
    controller = Controller()
    controller.stopping = False
    mover = StreamMover(service, "a", controller.is_stopping)
    await update(mover, "a", "b")
    await update(mover)
    await update(mover, "a")
    await update(mover, "a", "b")
    assert not service.draining
    assert len(service.streams) == 12
    controller.stopping = True
    await asyncio.sleep(0)
    assert not service.draining


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("websocket", {"type": "websocket.disconnect", "code": 1006, "reason": ""}),
        ("http", {"type": "http.disconnect"}),
    ],
)
async def test_a_lost_proxy_is_a_lost_client(kind: str, expected: dict[str, Any]) -> None:
    async def receive() -> dict[str, Any]:
        raise ray_exceptions.ActorDiedError

    async def send(message: Any) -> None: ...

    async def app(scope: Any, receive: Any, send: Any) -> None:
        assert await receive() == expected

    await PeerLoss(app)({"type": kind}, receive, send)


def test_metrics_are_copied_with_their_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    values: dict[tuple[str, tuple[tuple[str, str], ...]], float] = {}

    class FakeGauge:
        def __init__(self, name: str, description: str, tag_keys: tuple[str, ...]) -> None:
            self.name, self.keys = name, tag_keys

        def set(self, value: float, tags: dict[str, str]) -> None:
            assert tags.keys() == set(self.keys)
            values[self.name, tuple(tags.items())] = value

    monkeypatch.setattr(metrics, "Gauge", FakeGauge)
    registry = CollectorRegistry()
    Counter("lane_frames", "Frames.", ("reason",), registry=registry).labels("rate").inc(3)
    Histogram("lane_age", "Age.", buckets=(1.0,), registry=registry).observe(0.5)
    ray_metrics = metrics.RayMetrics()
    ray_metrics.export(registry.collect())
    ray_metrics.export(registry.collect())
    assert values == {
        ("lane_frames_total", (("reason", "rate"),)): 3.0,
        ("lane_age_bucket", (("le", "1.0"),)): 1.0,
        ("lane_age_bucket", (("le", "+Inf"),)): 1.0,
        ("lane_age_count", ()): 1.0,
        ("lane_age_sum", ()): 0.5,
    }
