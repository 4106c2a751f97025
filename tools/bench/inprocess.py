"""The pipeline without a service: what a program has that loads Lanestream itself, with as many threads."""

from __future__ import annotations

import asyncio
import signal
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from multiprocessing.connection import Connection

import cv2

from bench.frames import FPS, Clips, to_and_fro
from bench.orders import Answer, Kind, Order, Tally
from lanestream.detection import in_one
from lanestream.engine import Engine, load_engine
from lanestream.images.decoding import ImageLimits, decode
from lanestream.local import LocalCamera, LocalEngine
from lanestream.logs import log_config
from lanestream.runtime import Provider
from lanestream.settings import load_settings
from lanestream.workers.capabilities import Capabilities
from lanestream.workers.frame_worker import EncodedFrame
from lanestream.workers.ipc import Setup
from lanestream.workers.pool import WorkerPool
from lanestream.workers.process_pool import ProcessPool, usual_processes
from lanestream.workers.thread_pool import ThreadPool


@dataclass(frozen=True)
class Hello:
    """What the pipeline tells of itself.

    The service's processes and their threads, the network, and patches a frame of the largest size.
    """

    processes: int
    threads: int
    model: str
    provider: str
    patches: float


def run_pipeline(pipe: Connection, clips: Clips, provider: Provider) -> None:
    """The process: takes orders from `pipe` until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    settings = load_settings()
    cv2.setNumThreads(settings.opencv_threads)
    load = partial(load_engine, provider=provider, options=settings.runtime_options)
    engine = load()
    processes = settings.processes or usual_processes(Capabilities.of(engine.pipelines))
    threads = processes * settings.threads_per_process(processes)
    network = engine.network
    patches = patches_per_frame(engine, clips[max(clips)])
    with ThreadPoolExecutor(1) as worker, asyncio.Runner() as loop:
        setup = Setup(load, settings.image_limits, settings.opencv_threads, log_config(settings))
        runners: dict[Kind, WorkerPool] = {
            "pipeline": ThreadPool(engine, settings.image_limits, threads),
            "pool": worker.submit(
                loop.run, ProcessPool.started(setup, processes, settings.threads_per_process)
            ).result(),
        }
        pipe.send(Hello(processes, threads // processes, network.name, network.provider, patches))
        while True:
            order: Order = pipe.recv()
            cameras = Cameras(engine, order, clips[order.size], threads)
            runner = runners.get(order.kind)
            step = cameras.loop if runner is None else partial(loop.run, cameras.run(runner))
            working = worker.submit(step)
            while not pipe.poll(0.02):
                if cameras.settled:
                    pipe.send(None)
                    break
            pipe.recv()
            cameras.stopped.set()
            error = working.exception()
            pipe.send(cameras.tally if error is None else f"the pipeline in process failed: {error!r}")


def patches_per_frame(engine: Engine, jpegs: Sequence[bytes]) -> float:
    """How many patches the default detector shows its network, in the mean over a drive."""
    session = engine.open_session()
    patches = 0
    for number, jpeg in enumerate(jpegs):
        steps = in_one(session.follow(decode(jpeg, ImageLimits()), number / FPS))
        try:
            question = next(steps)
            while True:
                patches += len(question.inputs) if question.network is engine.network else 0
                question = steps.send(question.network.run(question.inputs))
        except StopIteration:
            pass
    return patches / len(jpegs)


@dataclass
class Cameras:
    """The cameras of an order, from image files to lanes; each has one frame at a time on its way."""

    engine: Engine
    order: Order
    jpegs: Sequence[bytes]
    threads: int
    tally: Tally = field(default_factory=Tally)
    stopped: threading.Event = field(default_factory=threading.Event)
    _answered: set[int] = field(default_factory=set)

    @property
    def settled(self) -> bool:
        """Whether every camera had an answer."""
        return len(self._answered) == self.order.sessions

    def loop(self) -> None:
        """As a script would: every thread takes the frames of its cameras one after the other, from end to end."""
        local, threads = LocalEngine(self.engine), self.threads
        cameras = [(number, local.open_camera(detector=self.order.detector)) for number in range(self.order.sessions)]
        with ThreadPoolExecutor(threads) as workers:
            list(workers.map(self._loop, [cameras[thread::threads] for thread in range(min(threads, len(cameras)))]))

    async def run(self, runner: WorkerPool) -> None:
        """As a service runs it: its threads or processes and its batches, nothing of the network."""
        cameras = [asyncio.create_task(self._follow(runner, number)) for number in range(self.order.sessions)]
        stopped = asyncio.create_task(asyncio.to_thread(self.stopped.wait))
        done, _ = await asyncio.wait({stopped, *cameras}, return_when=asyncio.FIRST_COMPLETED)
        for camera in cameras:
            camera.cancel()
        await asyncio.wait(cameras)
        self.stopped.set()
        await asyncio.gather(*done)

    async def _follow(self, runner: WorkerPool, number: int) -> None:
        camera, seq = runner.open_camera(detector=self.order.detector), 0
        while True:
            started = time.monotonic()
            async with runner.turn():
                await runner.run(camera, EncodedFrame(self._jpeg(number, seq), seq / FPS, started))
            self._note(number, started)
            seq += 1

    def _loop(self, cameras: Sequence[tuple[int, LocalCamera]]) -> None:
        for seq, (number, camera) in ((seq, camera) for seq in count() for camera in cameras):
            if self.stopped.is_set():
                return
            started = time.monotonic()
            camera.lanes(self._jpeg(number, seq), seq=seq, timestamp=seq / FPS)
            self._note(number, started)

    def _jpeg(self, number: int, seq: int) -> bytes:
        return self.jpegs[to_and_fro(7 * number + seq, len(self.jpegs))]

    def _note(self, number: int, started: float) -> None:
        self.tally.answers.append(Answer(number, started, time.monotonic()))
        self._answered.add(number)
