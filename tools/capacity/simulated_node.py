"""A simulated node: one event loop, worker processes, and the service's own rules for frames and their admission.

`StreamProtocol` and `FairQueue` are the classes of the service. What is modeled are the times: of the event loop, which
does one thing after the other, of the workers, which take one frame at a time, and of the processors that they share.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from functools import partial
from random import Random
from typing import Any, Final

import simpy

from capacity.calibration import Calibration, ServiceTime
from capacity.cpu_group import PERIOD_S
from capacity.processor import Processor
from lanestream.protocol import FrameMessage, Mode, StartMessage
from lanestream.streaming.stream_protocol import FrameOutcome, StreamLimits, StreamProtocol
from lanestream.workers.admission import FairQueue

Process = Generator[simpy.Event, Any, None]

# The event loop receives a frame, hands it to a worker, takes the result and answers: a quarter of its time each.
_STEPS: Final = 4
# As in `workers.worker`: the least that an unfinished frame counts for when the next one is assigned.
_LEAST_S: Final = 0.005
# As in `streaming.session_registry`: how often a stream is saved at most.
_SAVE_S: Final = 0.25
# A round trip to Redis in the same network, which opening and resuming a session wait for.
_REDIS_S: Final = 0.001


@dataclass(frozen=True)
class NodeShape:
    """The size of a node: its worker processes, its processors, and the limit of processor time, if there is one."""

    workers: int = 1
    processors: int = 2
    limit: float | None = None


@dataclass(eq=False)
class _Job:
    """A frame in a worker, as the service knows it: what it expects, and when the frame was begun."""

    expected_s: float
    service: ServiceTime
    deadline: float | None
    done: simpy.Event
    begun: float | None = None


@dataclass(eq=False)
class _Worker:
    inbox: simpy.Store
    jobs: list[_Job] = field(default_factory=list)

    def backlog_s(self, now: float) -> float:
        """As `Worker.backlog_s` of the service."""
        return sum(max(job.expected_s - (0.0 if job.begun is None else now - job.begun), _LEAST_S) for job in self.jobs)


class SimulatedNode:
    """A node with service times drawn from a calibration."""

    def __init__(self, env: simpy.Environment, shape: NodeShape, calibration: Calibration, chance: Random) -> None:
        self.env = env
        self.lost = False
        # Its connections, also of streams that are being opened.
        self.connections = 0
        self.saves = 0
        # From the arrival of each frame to its beginning in a worker.
        self.queue_delays: list[float] = []
        self._calibration, self._chance = calibration, chance
        self._processor = Processor(env, shape.processors, shape.limit, PERIOD_S * chance.random())
        self._loop = simpy.Resource(env)
        slots = shape.workers
        # As in `WorkerPool`, with one thread in each worker.
        self.admission = FairQueue(slots + shape.workers, slots, (slots + 1) // 2, lambda: env.now)
        self._workers = [_Worker(simpy.Store(env)) for _ in range(shape.workers)]
        self._busy_s = 0.0
        for worker in self._workers:
            env.process(self._work(worker))

    @property
    def processor_s(self) -> float:
        """The processor time used so far."""
        return self._processor.used_s

    @property
    def busy_s(self) -> float:
        """The time that the workers had a frame so far, of all workers together."""
        return self._busy_s

    def service_time(self) -> ServiceTime:
        """Draws what a frame costs."""
        return self._chance.choice(self._calibration.frames)

    def loop_work(self, seconds: float) -> Process:
        """Waits for the event loop and occupies it."""
        with self._loop.request() as turn:
            yield turn
            yield self._processor.run(seconds)

    def open_stream(self) -> Process:
        """Does what the handshake and `start` of a stream cost."""
        yield from self.loop_work(self._calibration.open_s)
        yield self.env.timeout(_REDIS_S)

    def save(self) -> Process:
        """Saves a session."""
        self.saves += 1
        yield from self.loop_work(self._calibration.save_s)

    def process(self, service: ServiceTime, expected_s: float, deadline: float | None) -> simpy.Event:
        """Gives a frame to the worker with the least work. Returns the event of its end; its value is the outcome."""
        worker = min(self._workers, key=lambda each: each.backlog_s(self.env.now))
        job = _Job(expected_s, service, deadline, self.env.event())
        worker.jobs.append(job)
        worker.inbox.put(job)
        return job.done

    def _work(self, worker: _Worker) -> Process:
        while True:
            job: _Job = yield worker.inbox.get()
            job.begun = began = self.env.now
            outcome = FrameOutcome.EXPIRED
            if job.deadline is None or job.deadline >= self.env.now:
                outcome = FrameOutcome.ANSWERED
                yield self._processor.run(job.service.worker_s)
                if job.service.wait_s > 0.0:
                    yield self.env.timeout(job.service.wait_s)
            self._busy_s += self.env.now - began
            worker.jobs.remove(job)
            job.done.succeed(outcome)


class SimulatedStream:
    """The node's side of one stream. `answer` is called with the number of each frame that leaves the node.

    Its second argument says whether the frame has lanes; a frame that expired has none.
    """

    def __init__(self, node: SimulatedNode, mode: Mode, caller: str, answer: Callable[[int, bool], None]) -> None:
        self._node, self._caller, self._answer = node, caller, answer
        self._mode = mode
        self._env = node.env
        self._protocol = StreamProtocol(StreamLimits(), self._env.now)
        self._protocol.receive_start(StartMessage(mode=mode), self._env.now)
        self._received = self._env.event()
        self._services: dict[int, ServiceTime] = {}
        self._saved_at = -_SAVE_S
        self._save_is_due = False
        self.closed = False
        self._env.process(self._answer_frames())

    def close(self) -> None:
        """Ends the stream. Frames that it still has are not answered."""
        self.closed = True

    def receive(self, seq: int) -> Process:
        """Receives a frame that has arrived at the node."""
        service = self._node.service_time()
        yield from self._node.loop_work(service.loop_s / _STEPS)
        if self._is_gone:
            return
        self._services[seq] = service
        self._protocol.receive_message(FrameMessage(seq=seq), self._env.now)
        self._protocol.receive_image(b"", self._env.now)
        if not self._received.triggered:
            self._received.succeed()

    @property
    def _is_gone(self) -> bool:
        return self.closed or self._node.lost

    def _answer_frames(self) -> Process:
        while not self._is_gone:
            if self._protocol.has_waiting_frame:
                yield from self._answer_next()
                continue
            self._received = self._env.event()
            yield self._received

    def _answer_next(self) -> Process:
        node, env = self._node, self._env
        self._protocol.request_slot()
        admitted = env.event()
        waiter = node.admission.enter(self._caller, partial(_succeed, admitted), latest=self._mode == "latest")
        yield admitted
        frame = self._protocol.take_frame()
        assert frame is not None  # noqa: S101 - a waiting frame is replaced, never removed
        service = self._services.pop(frame.seq)
        yield from node.loop_work(service.loop_s / _STEPS)
        node.queue_delays.append(env.now - frame.arrived)
        outcome: FrameOutcome = yield node.process(service, waiter.slot.expected_s, frame.deadline)
        yield from node.loop_work(service.loop_s / _STEPS)
        waiter.slot.charge(service.worker_s)
        node.admission.leave(waiter)
        self._protocol.complete_frame(outcome, env.now)
        self._save()
        yield from node.loop_work(service.loop_s / _STEPS)
        # Frames that were replaced will not be answered.
        self._services = {seq: each for seq, each in self._services.items() if seq > frame.seq}
        if not self._is_gone:
            self._answer(frame.seq, outcome is FrameOutcome.ANSWERED)

    def _save(self) -> None:
        """Counts the saves of the session: one now, or one when the last one is old enough."""
        if self._save_is_due:
            return
        self._save_is_due = True
        self._env.process(self._save_later(max(0.0, self._saved_at + _SAVE_S - self._env.now)))

    def _save_later(self, delay_s: float) -> Process:
        yield self._env.timeout(delay_s)
        self._save_is_due = False
        self._saved_at = self._env.now
        if not self._is_gone:
            yield from self._node.save()


def _succeed(event: simpy.Event) -> None:
    event.succeed()
