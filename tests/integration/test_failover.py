"""Client streams over real services whose connections break, or that drain or are killed."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import fakes
import pytest
import redis
from processes import service
from redisserver import redis_server
from tcpproxy import tcp_proxy

from lanestream.protocol import EgoModel
from lanestream.streaming.record import SessionRecord
from lanestream_client import LaneClient, SourceFrame, StreamResult

STREAMS = 4
IN_FLIGHT = 2
# The answers of a stream before its replica ends: its boundaries have ids by then.
ANSWERS = 6
SLOW_WAIT_S = 6 * fakes.WAIT_S  # loading and running real networks is slow when other tests run in parallel


def frames(count: int, image: bytes | None = None) -> Iterator[SourceFrame]:
    data = image or fakes.image_file()
    return (SourceFrame(seq, 0.04 * seq, data=data) for seq in range(count))


def track_ids(results: list[StreamResult]) -> set[int]:
    return {lane.track_id for result in results if result.lanes is not None for lane in result.lanes.lanes}


@pytest.mark.parametrize("mode", ["all", "latest"])
def test_track_ids_survive_broken_connections(url: str, mode: str) -> None:
    port = int(url.rpartition(":")[2])
    with tcp_proxy(port) as proxy, LaneClient(f"http://127.0.0.1:{proxy.port}", in_flight=3) as client:
        stream = client.stream(frames(60), mode=mode, session="cut-off")
        results = []
        for result in stream:
            results.append(result)
            if len(results) in (20, 40):
                proxy.cut()
    numbers = [result.frame.seq for result in results]
    assert numbers == sorted(set(numbers))
    assert stream.reconnects == 2
    assert stream.ready is not None
    assert (stream.ready.resumed, stream.ready.session) == (True, "cut-off")
    assert track_ids(results) == {1, 2}
    total = stream.summary
    assert total is not None
    assert (total.frames, total.dropped) == (60, 60 - len(results))
    assert mode == "latest" or total.dropped == 0
    assert {result.error.code for result in results if result.error} <= {"lost"}


def wait_until_saved(redis_url: str) -> None:
    """Waits until Redis has each stream after its first answers: a replica saves it in the background."""
    end = time.monotonic() + SLOW_WAIT_S
    with redis.Redis.from_url(redis_url) as client:
        while time.monotonic() < end:
            data = [client.hget(key, "data") for key in client.scan_iter("lanestream:session:*")]
            records = [SessionRecord.from_bytes(value) for value in data if isinstance(value, bytes)]
            if sum(record is not None and (record.last_seq or 0) >= ANSWERS - 1 for record in records) == STREAMS:
                return
            time.sleep(0.05)
    pytest.fail("the streams were not saved")


@dataclass
class CameraClient:
    """Streams one image in mode `all`, over any of the replicas, until `stop` is set.

    Waits at `barrier` when its first stream is running, and when it has reconnected. `egos` holds the latest ego lane
    of each connection.
    """

    urls: list[str]
    image: bytes
    barrier: threading.Barrier
    stop: threading.Event
    results: list[StreamResult] = field(default_factory=list)
    egos: list[EgoModel] = field(default_factory=list)
    frames: int = 0

    def run(self) -> None:
        with LaneClient(self.urls, in_flight=IN_FLIGHT) as client:
            stream = client.stream(self._source(), mode="all")
            for result in stream:
                self.results.append(result)
                if len(self.results) == ANSWERS:
                    self.barrier.wait(SLOW_WAIT_S)
                if result.lanes is not None and stream.reconnects == len(self.egos) - 1:
                    self.egos[-1] = result.lanes.ego
                elif result.lanes is not None:
                    self.egos.append(result.lanes.ego)
                    assert stream.ready is not None
                    assert stream.ready.resumed == (stream.reconnects > 0)
                    if stream.reconnects:
                        self.barrier.wait(SLOW_WAIT_S)
            assert stream.summary is not None
            assert stream.summary.frames == stream.summary.answered + stream.summary.lost

    def _source(self) -> Iterator[SourceFrame]:
        for frame in frames(100_000, self.image):
            if self.stop.is_set():
                return
            self.frames += 1
            yield frame


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM], ids=["killed", "drained"])
def test_every_stream_continues_on_the_other_replica(tmp_path: Path, road: bytes, end: signal.Signals) -> None:
    with (
        redis_server(tmp_path) as redis_url,
        service(redis_url=redis_url, regressor="none") as (process, one),
        service(redis_url=redis_url, regressor="none") as (_, other),
    ):
        barrier, stop = threading.Barrier(STREAMS + 1), threading.Event()
        cameras = [CameraClient([one, other], road, barrier, stop) for _ in range(STREAMS)]
        threads = [threading.Thread(target=camera.run) for camera in cameras]
        for thread in threads:
            thread.start()
        barrier.wait(SLOW_WAIT_S)
        wait_until_saved(redis_url)
        process.send_signal(end)
        barrier.wait(SLOW_WAIT_S)
        stop.set()
        for thread in threads:
            thread.join(SLOW_WAIT_S)
    for camera in cameras:
        before, after = camera.egos
        assert None not in (before.left, before.right)
        assert (after.left, after.right) == (before.left, before.right)
        assert [result.frame.seq for result in camera.results] == list(range(camera.frames))
        lost = [result.error.code for result in camera.results if result.error is not None]
        assert set(lost) <= {"lost"}
        assert len(lost) <= (IN_FLIGHT if end is signal.SIGKILL else 0)
