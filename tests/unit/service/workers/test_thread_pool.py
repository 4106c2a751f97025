"""Frames in threads, without a service around them."""

from __future__ import annotations

import asyncio
import threading
import time
from contextlib import AsyncExitStack

import fakes
import numpy as np
import pytest
from numpy.typing import NDArray

from lanestream.detection.interface import Detections, FrameContext, Infer
from lanestream.errors import ExpiredError, NoDetectorError
from lanestream.images.decoding import ImageLimits
from lanestream.messages import ProcessedFrame
from lanestream.road.view import Image
from lanestream.session import DEFAULT_SESSION, SessionOptions
from lanestream.workers.admission import Slot
from lanestream.workers.capabilities import Capabilities
from lanestream.workers.frame_worker import EncodedFrame
from lanestream.workers.pool import SessionHandle, WorkerPool
from lanestream.workers.thread_pool import ThreadPool


class CountingModel(fakes.FakeModel):
    """Returns the shades of its inputs, and records the size of each batch."""

    def __init__(self) -> None:
        self.batches: list[int] = []

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.batches.append(len(inputs))
        return inputs[:, 0, 0, :2].astype(np.float32)


class ShadeDetector(fakes.FakeDetector):
    """Asks the model three times, for inputs of different shades, and checks that it gets the outputs of each."""

    def detect(self, image: Image, context: FrameContext, infer: Infer) -> Detections:
        for shade in (10, 20, 30):
            outputs = infer("classifier", np.full((2, 8, 8, 3), shade, np.uint8))
            assert outputs[:, 0].tolist() == [shade, shade]
        return super().detect(image, context, infer)


class IdlePool(WorkerPool):
    """A pool that admits frames and never processes one."""

    def __init__(self, workers: int, threads: int) -> None:
        super().__init__(Capabilities.of(fakes.engine()), workers, threads, 1)

    def open_session(self, options: SessionOptions = DEFAULT_SESSION) -> SessionHandle:
        raise NotImplementedError

    async def run(self, session: SessionHandle, frame: EncodedFrame, slot: Slot) -> ProcessedFrame:
        raise NotImplementedError


def encoded(timestamp: float = 0.0, deadline: float | None = None) -> EncodedFrame:
    return EncodedFrame(fakes.image_file(), timestamp, time.monotonic(), deadline)


async def run_together(model: CountingModel, threads: int, cameras: int) -> list[ProcessedFrame]:
    """Returns the results of one frame of each camera, all given to the pool at the same time."""
    pool, single = (
        ThreadPool(fakes.engine(model, ShadeDetector()), ImageLimits(), threads),
        SessionOptions(single_image=True),
    )
    frames = await asyncio.gather(*(pool.run(pool.open_session(single), encoded(), Slot()) for _ in range(cameras)))
    await pool.close()
    return frames


@pytest.mark.parametrize("threads", [1, 3])
async def test_frames_of_many_cameras_have_the_same_lanes_as_a_frame_alone(threads: int) -> None:
    model = CountingModel()
    (alone,) = await run_together(model, threads=8, cameras=1)
    curves = [lane.curve for lane in alone.result.lanes]
    assert len(curves) == 2
    for frame in await run_together(model, threads, cameras=5):
        assert [lane.curve for lane in frame.result.lanes] == curves
    assert sum(model.batches) == 6 * (3 * 2 + 2), "every input is run once"


async def test_a_frame_has_the_duration_of_each_stage_which_add_up_to_its_total() -> None:
    pool = ThreadPool(fakes.engine(), ImageLimits(), 1)
    frame = await pool.run(pool.open_session(), encoded(), Slot())
    await pool.close()
    timing = frame.result.timing_ms
    assert set(timing) == {"decode", "propose", "infer", "fit", "track", "queue", "total"}
    assert min(timing.values()) >= 0.0
    assert sum(timing.values()) - timing["total"] == pytest.approx(timing["total"], abs=1e-6)


async def test_an_expired_frame_is_never_run_and_leaves_the_session_as_it_was() -> None:
    model = CountingModel()
    pool = ThreadPool(fakes.engine(model), ImageLimits(), 1)
    session = pool.open_session()
    before = session.state
    with pytest.raises(ExpiredError):
        await pool.run(session, encoded(deadline=time.monotonic() - 1.0), Slot())
    await pool.close()
    assert model.batches == []
    assert session.state == before


async def test_a_detector_that_is_missing_is_an_error() -> None:
    pool = ThreadPool(fakes.engine(), ImageLimits(), 1)
    with pytest.raises(NoDetectorError, match="there is no detector regression here"):
        pool.open_session(SessionOptions(detector="regression"))
    assert (pool.works, pool.pids) == (True, ())
    await pool.close()


async def test_functions_run_in_a_thread_of_the_pool() -> None:
    pool = ThreadPool(fakes.engine(), ImageLimits(), 1)
    name, numbers = await pool.in_thread(
        lambda *args, **kwargs: (threading.current_thread().name, [args, kwargs]), 1, b=2
    )
    await pool.close()
    assert name.startswith("lanestream-frames")
    assert numbers == [(1,), {"b": 2}]


@pytest.mark.parametrize(("workers", "threads", "slots", "latest_slots"), [(1, 3, 4, 1), (2, 1, 4, 2), (1, 8, 9, 6)])
async def test_a_pool_admits_one_frame_more_than_its_threads_and_fewer_of_mode_latest(
    workers: int, threads: int, slots: int, latest_slots: int
) -> None:
    for latest, expected in ((False, slots), (True, latest_slots)):
        pool = IdlePool(workers, threads)
        async with AsyncExitStack() as stack:
            for _ in range(expected):
                await stack.enter_async_context(pool.admit("camera", latest=latest))
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(stack.enter_async_context(pool.admit("camera", latest=latest)), 0.05)
        await pool.close()
