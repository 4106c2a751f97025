"""The in-process runners: a program that loads Lanestream itself, with as many threads as the service has."""

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
import numpy as np
from numpy.typing import NDArray

from bench.frames import FPS, Clips, forward_and_backward
from bench.workload import PIPELINE, POOL, LoadRequest, LoadResult, Reply
from lanestream.detection.interface import ModelRole
from lanestream.engine import Engine, load_engine
from lanestream.images.decoding import ImageLimits, decode
from lanestream.local import LocalCamera, LocalEngine
from lanestream.logs import log_config
from lanestream.session import SessionOptions
from lanestream.settings import load_settings
from lanestream.workers.capabilities import Capabilities
from lanestream.workers.frame_worker import EncodedFrame
from lanestream.workers.ipc import WorkerSetup
from lanestream.workers.pool import WorkerPool
from lanestream.workers.process_pool import ProcessPool, default_processes
from lanestream.workers.thread_pool import ThreadPool


@dataclass(frozen=True)
class PipelineInfo:
    """The service's processes and the threads of each, the default network, and its patches per frame (LARGE)."""

    processes: int
    threads: int
    model: str
    provider: str
    patches: float


def run_pipeline(pipe: Connection, clips: Clips, provider: str) -> None:
    """Serves load requests from `pipe` until it is closed; the target of a process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    settings = load_settings()
    cv2.setNumThreads(settings.opencv_threads)
    load = partial(load_engine, provider=provider, options=settings.runtime_options)
    engine = load()
    processes = settings.processes or default_processes(Capabilities.of(engine))
    threads = processes * settings.threads_per_process(processes)
    model = engine.main_model()
    patches = patches_per_frame(engine, clips[max(clips)])
    with ThreadPoolExecutor(1) as worker, asyncio.Runner() as loop:
        setup = WorkerSetup(load, settings.image_limits, settings.opencv_threads, log_config(settings))
        pools: dict[str, WorkerPool] = {
            PIPELINE: ThreadPool(engine, settings.image_limits, threads),
            POOL: worker.submit(loop.run, ProcessPool.start(setup, processes, settings.threads_per_process)).result(),
        }
        provider = model.placement.provider
        pipe.send(PipelineInfo(processes, threads // processes, model.name, provider, patches))
        while True:
            request: LoadRequest = pipe.recv()
            cameras = InProcessCameras(engine, request, clips[request.size], threads)
            pool = pools.get(request.runner)
            run = cameras.run_loop if pool is None else partial(loop.run, cameras.run_pool(pool))
            future = worker.submit(run)
            while not pipe.poll(0.02):
                if cameras.settled:
                    pipe.send(None)
                    break
            pipe.recv()
            cameras.stopped.set()
            error = future.exception()
            pipe.send(cameras.result if error is None else f"an in-process runner failed: {error!r}")


def patches_per_frame(engine: Engine, jpegs: Sequence[bytes]) -> float:
    """Returns how many patches per frame the default detector classifies, on average over a drive."""
    session, main_role = engine.open_session(), engine.main_roles[engine.select()]
    patches = 0

    def infer(role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        nonlocal patches
        patches += len(inputs) if role == main_role else 0
        return engine.models[role].run(inputs)

    for number, jpeg in enumerate(jpegs):
        session.process(decode(jpeg, ImageLimits()), number / FPS, infer)
    return patches / len(jpegs)


@dataclass
class InProcessCameras:
    """The cameras of a load request, from image files to lanes. Each camera has one frame in progress at a time."""

    engine: Engine
    request: LoadRequest
    jpegs: Sequence[bytes]
    threads: int
    result: LoadResult = field(default_factory=LoadResult)
    stopped: threading.Event = field(default_factory=threading.Event)
    _answered: set[int] = field(default_factory=set)

    @property
    def settled(self) -> bool:
        """Whether every camera has had a reply."""
        return len(self._answered) == self.request.sessions

    def run_loop(self) -> None:
        """Works like a script: every thread processes the frames of its cameras one after the other."""
        local, threads = LocalEngine(self.engine), self.threads
        cameras = [
            (number, local.open_camera(detector=self.request.detector)) for number in range(self.request.sessions)
        ]
        with ThreadPoolExecutor(threads) as workers:
            list(workers.map(self._loop, [cameras[thread::threads] for thread in range(min(threads, len(cameras)))]))

    async def run_pool(self, pool: WorkerPool) -> None:
        """Works like the service, with its threads or processes and its batches, but without the network."""
        cameras = [asyncio.create_task(self._stream(pool, number)) for number in range(self.request.sessions)]
        stopped = asyncio.create_task(asyncio.to_thread(self.stopped.wait))
        done, _ = await asyncio.wait({stopped, *cameras}, return_when=asyncio.FIRST_COMPLETED)
        for camera in cameras:
            camera.cancel()
        await asyncio.wait(cameras)
        self.stopped.set()
        await asyncio.gather(*done)

    async def _stream(self, pool: WorkerPool, number: int) -> None:
        session, seq = pool.open_session(SessionOptions(detector=self.request.detector)), 0
        while True:
            started = time.monotonic()
            async with pool.admit("bench") as slot:
                await pool.run(session, EncodedFrame(self._jpeg(number, seq), seq / FPS, started), slot)
            self._add_reply(number, started)
            seq += 1

    def _loop(self, cameras: Sequence[tuple[int, LocalCamera]]) -> None:
        for seq, (number, camera) in ((seq, camera) for seq in count() for camera in cameras):
            if self.stopped.is_set():
                return
            started = time.monotonic()
            camera.lanes(self._jpeg(number, seq), seq=seq, timestamp=seq / FPS)
            self._add_reply(number, started)

    def _jpeg(self, number: int, seq: int) -> bytes:
        return self.jpegs[forward_and_backward(7 * number + seq, len(self.jpegs))]

    def _add_reply(self, number: int, started: float) -> None:
        self.result.replies.append(Reply(number, started, time.monotonic()))
        self._answered.add(number)
