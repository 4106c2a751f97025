"""Measures one load on one contestant, all others held still."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from bench.contestants import Server, Watched, programs
from bench.frames import Clips
from bench.inprocess import Hello, run_pipeline
from bench.load import generate
from bench.orders import Answer, Helper, Kind, Order
from bench.plan import LOOP, PIPELINE, POOL, Cell
from lanestream.runtime import Provider

# Two load generators, so that a burst of answers for many sessions does not wait for one.
GENERATORS: Final = 2
SETTLE_S: Final = 15.0
# The clock runs for so many times as long as it took until every session had an answer, if that is longer than planned.
CYCLES: Final = 2.5
# Answers that come within so many seconds are those of one batch.
BATCH_S: Final = 0.01
# With more frames in flight than this, a server that answers those who have left is started anew for the next cell.
CROWD: Final = 8
_IN_PROCESS: Final[dict[str, Kind]] = {PIPELINE: "pipeline", LOOP: "loop", POOL: "pool"}


@dataclass(frozen=True)
class Sample:
    """What one load came to: the answers that came in the same `seconds`, of sessions that have a number each.

    `settled` tells whether every session had an answer before the clock started: otherwise times from frame to reply
    are those of a queue that is still getting longer. `generator_share` is the load generators' share of all
    processors; the pipeline in process has none.
    """

    answers: tuple[Answer, ...]
    failed: int
    seconds: float
    processor_s: float
    memory_mb: float
    generator_share: float
    settled: bool

    @property
    def fps(self) -> float:
        """Answers a second, from the first ones to the last one.

        Answers come in batches, so that a count would depend on where the seconds begin. Where some sessions had none
        before the clock started, the few that others had tell no rate: they are counted.
        """
        rate = _rate(sorted(answer.answered for answer in self.answers)) if self.settled else None
        return len(self.answers) / self.seconds if rate is None else rate

    @property
    def milliseconds(self) -> list[float]:
        """From frame to reply."""
        return [1e3 * (answer.answered - answer.sent) for answer in self.answers]

    @property
    def processor_ms_per_frame(self) -> float | None:
        """Processor time of the contestant for each answer; None without any."""
        return 1e3 * self.processor_s / len(self.answers) if self.answers else None


class Bench:
    """All contestants, warm and held still, and the load generators."""

    def __init__(self, hello: Hello, pipeline: Helper, servers: Sequence[Server], generators: Sequence[Helper]) -> None:
        self.hello = hello
        self._pipeline = pipeline
        self.servers = {server.name: server for server in servers}
        self._generators = generators
        self._watched = Watched(pipeline.pid)

    def measure(self, cell: Cell) -> Sample:
        """One cell of the plan."""
        order = Order(cell.size, cell.sessions, cell.in_flight, detector=cell.detector)
        return self.load(cell.contestant, order, cell.seconds)

    def load(self, contestant: str, order: Order, seconds: float) -> Sample:
        """`order` for so many seconds on a contestant. Raises RuntimeError where a stream breaks."""
        if contestant in _IN_PROCESS:
            kind = _IN_PROCESS[contestant]
            with _running(self._watched) as watched:
                return self._loaded(watched, [(self._pipeline, replace(order, kind=kind))], seconds)
        server = self.servers[contestant]
        addressed = replace(order, kind=server.kind, url=server.url)
        with _running(server.watched) as watched:
            sample = self._loaded(watched, shared_out(addressed, self._generators), seconds)
        if server.kind != "lanestream" and order.sessions * order.in_flight > CROWD:
            server.restart()
            server.watched.suspend()
        return sample

    def _loaded(self, watched: Watched, shares: Sequence[tuple[Helper, Order]], seconds: float) -> Sample:
        generators = [Watched(helper.pid) for helper, _ in shares if helper is not self._pipeline]
        for helper, share in shares:
            helper.begin(share)
        begun = time.monotonic()
        settled = all(helper.wait_until_settled(begun + SETTLE_S - time.monotonic()) for helper, _ in shares)
        seconds = max(seconds, CYCLES * (time.monotonic() - begun)) if settled else seconds
        used, generated, started = watched.processor_seconds(), _sum(generators), time.monotonic()
        time.sleep(seconds)
        used, generated = watched.processor_seconds() - used, _sum(generators) - generated
        ended, memory = time.monotonic(), watched.memory_mb()
        tallies = [helper.stop() for helper, _ in shares]
        answers = [
            replace(answer, session=answer.session * len(tallies) + number)
            for number, tally in enumerate(tallies)
            for answer in tally.answers
            if started <= answer.answered <= ended
        ]
        processors = (ended - started) * len(os.sched_getaffinity(0))
        failed = sum(tally.failed for tally in tallies)
        return Sample(tuple(answers), failed, ended - started, used, memory, generated / processors, settled)


@contextmanager
def _running(watched: Watched) -> Iterator[Watched]:
    watched.resume()
    try:
        yield watched
    finally:
        watched.suspend()


def _rate(times: Sequence[float]) -> float | None:
    """Answers a second after those that came together with the first one; None where there are no others."""
    if not times:
        return None
    together = sum(time <= times[0] + BATCH_S for time in times)
    return (len(times) - together) / (times[-1] - times[together - 1]) if together < len(times) else None


def shared_out(order: Order, generators: Sequence[Helper]) -> list[tuple[Helper, Order]]:
    """The sessions of an order, shared out among the load generators."""
    parts = [len(range(index, order.sessions, len(generators))) for index in range(len(generators))]
    return [(helper, replace(order, sessions=part)) for helper, part in zip(generators, parts, strict=True) if part]


@contextmanager
def bench(clips: Clips, provider: Provider, folder: Path) -> Iterator[Bench]:
    """All contestants, started and warm; afterwards none is left. Logs go to `folder`."""
    with ExitStack() as stack:
        pipeline = _helper(stack, run_pipeline, clips, provider)
        hello: Hello = pipeline.hello()
        watched = Watched(pipeline.pid)
        # With its workers, which would wait for ever where they were held still when it ended.
        stack.callback(watched.end)
        watched.suspend()
        generators = [_helper(stack, generate, clips) for _ in range(GENERATORS)]
        for generator in generators:
            generator.hello()
        servers = []
        for program in programs(provider):
            servers.append(Server(program, folder))
            stack.callback(servers[-1].close)
        for server in servers:
            server.wait_until_ready()
        for server in servers:
            server.watched.suspend()
        yield Bench(hello, pipeline, servers, generators)


def _helper(stack: ExitStack, work: object, *arguments: object) -> Helper:
    # Spawned, because a forked OpenCV or onnxruntime may wait for threads that the fork left behind.
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe()
    process = context.Process(target=work, args=(theirs, *arguments), daemon=True)  # type: ignore[arg-type]
    process.start()
    theirs.close()
    helper = Helper(process, mine)
    stack.callback(helper.close)
    return helper


def _sum(watched: Sequence[Watched]) -> float:
    return sum(each.processor_seconds() for each in watched)
