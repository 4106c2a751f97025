"""Frames on their way through the threads, without a service around them."""

from __future__ import annotations

import asyncio
from typing import Any

import fakes
import numpy as np
import pytest
from numpy.typing import NDArray

from lanestream.detection import Detections, Pipeline, Prepared
from lanestream.engine import Engine
from lanestream.images.decoding import ImageLimits
from lanestream.messages import ProcessedFrame
from lanestream.road.view import Image
from lanestream.workers.frame_worker import EncodedFrame
from lanestream.workers.thread_pool import ThreadPool


class Counting(fakes.FakeNetwork):
    """Remembers its batches; answers with their inputs' shades."""

    def __init__(self) -> None:
        self.batches: list[int] = []

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.batches.append(len(inputs))
        return inputs[:, 0, 0, :2].astype(np.float32)


class InParts(fakes.FakeDetector):
    """Makes its inputs, of three shades, part by part, and checks that the answers come in their order."""

    def prepare(self, image: Image, *known: Any, **more: Any) -> Prepared:
        whole = super().prepare(image, *known, **more)
        parts = tuple(lambda shade=shade: np.full((2, 8, 8, 3), shade, np.uint8) for shade in (10, 20, 30))
        return Prepared(image, parts, whole.view, (), 1.0)

    def finish(self, prepared: Prepared, outputs: NDArray[np.float32]) -> Detections:
        assert outputs[:, 0].tolist() == [10, 10, 20, 20, 30, 30]
        return super().finish(prepared, outputs)


def run_together(network: Counting, threads: int, cameras: int) -> list[ProcessedFrame]:
    """One frame of each camera, all at once."""
    engine = Engine([Pipeline("candidates", InParts(), network)])
    frame = EncodedFrame(fakes.image_file(), 0.0, 0.0)

    async def run() -> list[ProcessedFrame]:
        runner = ThreadPool(engine, ImageLimits(), threads)
        frames = await asyncio.gather(*(runner.run(runner.open_camera(), frame) for _ in range(cameras)))
        await runner.close()
        return frames

    return asyncio.run(run())


@pytest.mark.parametrize("threads", [1, 3])
def test_the_answers_are_the_same_in_parts_and_in_one(threads: int) -> None:
    network = Counting()
    (alone,) = run_together(network, threads=8, cameras=1)
    curves = [lane.curve for lane in alone.result.lanes]
    assert len(curves) == 2
    for crowded in run_together(network, threads, cameras=5):
        assert [lane.curve for lane in crowded.result.lanes] == curves
    assert sum(network.batches) == 6 * 6


def test_a_frame_in_a_crowd_asks_all_at_once() -> None:
    network = Counting()
    run_together(network, threads=1, cameras=4)
    assert network.batches == [6] * 4
