"""Measures workloads one after the other: while one runner runs, all others are stopped."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from bench.frames import Clips
from bench.in_process import PipelineInfo, run_pipeline
from bench.load_generator import generate
from bench.runners import HelperProcess, ProcessTree, Server, server_programs
from bench.workload import IN_PROCESS, LARGE, SERVICE, LoadRequest, Reply, Suite, Workload

# Two load generators, so that one burst of replies to many sessions does not wait for a single process.
GENERATORS: Final = 2
SETTLE_S: Final = 15.0
# A workload is measured for at least so many times as long as it took until every session had a reply.
MIN_CYCLES: Final = 2.5
# Replies within so many seconds belong to one batch.
BATCH_S: Final = 0.01
# A server that still works for clients that are gone is restarted after a workload with more frames in flight.
RESTART_ABOVE: Final = 8


@dataclass(frozen=True)
class Sample:
    """The result of one workload: the replies that came within `seconds`, with sessions numbered over all generators.

    `settled` is true if every session had a reply before the measurement began; otherwise the times from frame to
    reply are those of a queue that still grows. `generator_share` is the load generators' share of all processors; it
    is 0 for in-process runners.
    """

    replies: tuple[Reply, ...]
    failed: int
    seconds: float
    cpu_s: float
    memory_mb: float
    generator_share: float
    settled: bool

    @property
    def fps(self) -> float:
        """Replies per second, from the first ones to the last one.

        Replies come in batches, so a plain count would depend on where the interval begins. If some sessions had none
        before the measurement began, there are too few replies for a rate, and they are counted.
        """
        rate = _rate(sorted(reply.answered for reply in self.replies)) if self.settled else None
        return len(self.replies) / self.seconds if rate is None else rate

    @property
    def milliseconds(self) -> list[float]:
        """The time from frame to reply, of each reply."""
        return [1e3 * (reply.answered - reply.sent) for reply in self.replies]

    @property
    def cpu_ms_per_frame(self) -> float | None:
        """The runner's CPU time per reply, or None without replies."""
        return 1e3 * self.cpu_s / len(self.replies) if self.replies else None


@dataclass(frozen=True)
class Overload:
    """Clients that push `rate` frames per second each, and the result."""

    clients: int
    rate: float
    sample: Sample


@dataclass
class Results:
    """All samples by round. The last overload is the `soak`, with the service's memory in MB before it."""

    rounds: list[dict[Workload, Sample]] = field(default_factory=list)
    overloads: list[list[Overload]] = field(default_factory=list)
    soak: Overload | None = None
    memory_before_soak_mb: float = 0.0


class Benchmark:
    """All runners, warm and suspended, and the load generators."""

    def __init__(
        self,
        info: PipelineInfo,
        pipeline: HelperProcess,
        servers: Sequence[Server],
        generators: Sequence[HelperProcess],
    ) -> None:
        self.info = info
        self._pipeline = pipeline
        self.servers = {server.name: server for server in servers}
        self._generators = generators
        self._pipeline_processes = ProcessTree(pipeline.pid)

    def has_runner(self, name: str) -> bool:
        """Returns whether a runner is available here."""
        return name in IN_PROCESS or name in self.servers

    def measure(self, workload: Workload) -> Sample:
        """Measures one workload of a suite."""
        request = LoadRequest(
            workload.size,
            workload.sessions,
            workload.in_flight,
            detector=workload.detector,
            runner=workload.runner,
        )
        return self.load(request, workload.seconds)

    def load(self, request: LoadRequest, seconds: float) -> Sample:
        """Runs a load for some seconds on the request's runner. Raises RuntimeError if a stream breaks."""
        if request.runner in IN_PROCESS:
            with _resumed(self._pipeline_processes) as processes:
                return self._measured(processes, [(self._pipeline, request)], seconds)
        server = self.servers[request.runner]
        addressed = replace(request, transport=server.transport, url=server.url)
        with _resumed(server.processes) as processes:
            sample = self._measured(processes, split_load(addressed, self._generators), seconds)
        if server.transport != "lanestream" and request.sessions * request.in_flight > RESTART_ABOVE:
            server.restart()
            server.processes.suspend()
        return sample

    def _measured(
        self, processes: ProcessTree, parts: Sequence[tuple[HelperProcess, LoadRequest]], seconds: float
    ) -> Sample:
        generators = [ProcessTree(helper.pid) for helper, _ in parts if helper is not self._pipeline]
        return measure_load(processes, parts, generators, seconds)


def measure_load(
    processes: ProcessTree,
    parts: Sequence[tuple[HelperProcess, LoadRequest]],
    generators: Sequence[ProcessTree],
    seconds: float,
) -> Sample:
    """Lets helper processes run their parts of a load on the runner `processes`, for some seconds once it has settled.

    `generators` are those helpers that only generate load. Raises RuntimeError if a stream breaks.
    """
    for helper, part in parts:
        helper.start_load(part)
    begun = time.monotonic()
    settled = all(helper.wait_until_settled(begun + SETTLE_S - time.monotonic()) for helper, _ in parts)
    seconds = max(seconds, MIN_CYCLES * (time.monotonic() - begun)) if settled else seconds
    used, generated, started = processes.cpu_seconds(), _cpu_seconds(generators), time.monotonic()
    time.sleep(seconds)
    used, generated = processes.cpu_seconds() - used, _cpu_seconds(generators) - generated
    ended, memory = time.monotonic(), processes.memory_mb()
    results = [helper.stop_load() for helper, _ in parts]
    replies = [
        replace(reply, session=reply.session * len(results) + number)
        for number, result in enumerate(results)
        for reply in result.replies
        if started <= reply.answered <= ended
    ]
    available_s = (ended - started) * len(os.sched_getaffinity(0))
    failed = sum(result.failed for result in results)
    return Sample(tuple(replies), failed, ended - started, used, memory, generated / available_s, settled)


def run_suite(bench: Benchmark, suite: Suite, say: Callable[[str], None]) -> Results:
    """Measures all workloads of `suite` whose runners are available; `say` is called with a line on each step."""
    results = Results()
    for number in range(suite.rounds):
        results.rounds.append({})
        for workload in suite.round(number):
            if bench.has_runner(workload.runner):
                sample = bench.measure(workload)
                results.rounds[-1][workload] = sample
                say(f"{number + 1}/{suite.rounds}  {_describe(workload, sample)}")
        results.overloads.append(
            [_overload(bench, suite, results, count, suite.overload_seconds) for count in suite.overload_clients]
        )
    results.memory_before_soak_mb = bench.servers[SERVICE].processes.memory_mb()
    say(f"overload for {suite.soak_minutes:g} minutes")
    results.soak = _overload(bench, suite, results, max(suite.overload_clients), 60.0 * suite.soak_minutes)
    return results


def _overload(bench: Benchmark, suite: Suite, results: Results, clients: int, seconds: float) -> Overload:
    """Pushes more frames than the service answered in the last round, from some clients."""
    (capacity,) = (
        sample.fps
        for workload, sample in results.rounds[-1].items()
        if workload == replace(workload, runner=SERVICE, size=LARGE, sessions=suite.compared_sessions, in_flight=2)
    )
    rate = suite.overload_factor * max(capacity, 1.0) / clients
    return Overload(clients, rate, bench.load(LoadRequest(LARGE, clients, rate=rate), seconds))


def _describe(workload: Workload, sample: Sample) -> str:
    width, height = workload.size
    load = f"{width} x {height}, {workload.sessions:2} sessions, {workload.in_flight} in flight"
    return f"{workload.runner:9} {load}, {workload.detector}: {sample.fps:.1f} frames per second"


@contextmanager
def benchmark(clips: Clips, provider: str, folder: Path) -> Iterator[Benchmark]:
    """Starts and warms up all runners and ends them afterwards. Their logs go to `folder`."""
    with ExitStack() as stack:
        pipeline = start_helper(stack, run_pipeline, clips, provider)
        info: PipelineInfo = pipeline.wait_until_ready()
        processes = ProcessTree(pipeline.pid)
        # Its worker processes are suspended at the end, so they have to be killed with it.
        stack.callback(processes.end)
        processes.suspend()
        generators = [start_helper(stack, generate, clips) for _ in range(GENERATORS)]
        for generator in generators:
            generator.wait_until_ready()
        servers = []
        for program in server_programs(provider):
            servers.append(Server(program, folder))
            stack.callback(servers[-1].close)
        for server in servers:
            server.wait_until_ready()
        for server in servers:
            server.processes.suspend()
        yield Benchmark(info, pipeline, servers, generators)


def split_load(request: LoadRequest, generators: Sequence[HelperProcess]) -> list[tuple[HelperProcess, LoadRequest]]:
    """Divides the sessions of a load among the load generators."""
    counts = [len(range(index, request.sessions, len(generators))) for index in range(len(generators))]
    pairs = zip(generators, counts, strict=True)
    return [(helper, replace(request, sessions=count)) for helper, count in pairs if count]


def start_helper(stack: ExitStack, target: object, *arguments: object) -> HelperProcess:
    """Starts a helper process that runs `target(pipe, *arguments)`, and ends with `stack`."""
    # Spawned: after a fork, OpenCV or onnxruntime may wait for threads that exist in the parent only.
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=target, args=(theirs, *arguments), daemon=True)  # type: ignore[arg-type]
    process.start()
    theirs.close()
    helper = HelperProcess(process, ours)
    stack.callback(helper.close)
    return helper


@contextmanager
def _resumed(processes: ProcessTree) -> Iterator[ProcessTree]:
    processes.resume()
    try:
        yield processes
    finally:
        processes.suspend()


def _cpu_seconds(trees: Sequence[ProcessTree]) -> float:
    return sum(tree.cpu_seconds() for tree in trees)


def _rate(times: Sequence[float]) -> float | None:
    """Returns replies per second after the batch of the first one, or None if there are no others."""
    if not times:
        return None
    batch = sum(time <= times[0] + BATCH_S for time in times)
    return (len(times) - batch) / (times[-1] - times[batch - 1]) if batch < len(times) else None
