"""What a normal camera and /healthz feel, and the memory of the service, measured in a process of its own."""

from __future__ import annotations

import asyncio
import re
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Final

import psutil
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException
from websockets.typing import Subprotocol

from attack.target import Target
from attack.wire import head

_FRAME_S: Final = 0.2
_HEALTH_S: Final = 0.5
_NEWCOMER_S: Final = 1.0
_MEMORY_S: Final = 0.25
# One attempt to connect or to get an answer may take this long. Then the next one starts.
_ATTEMPT_S: Final = 3.0
_RETRY_S: Final = 0.25
_RECONNECT_S: Final = 0.1
# The service has warmed up after so many answers to each camera.
_WARM_ANSWERS: Final = 5
_WARM_S: Final = 30.0
# Answers that are still expected when the observation ends.
_LAST_ANSWERS_S: Final = 2.0
_FINISH_S: Final = 30.0
# A service that takes more is killed before it takes the memory of the whole machine.
_MOST_MB: Final = 6144.0
# Answers are not parsed as JSON, which would cost more than everything else.
_TYPE: Final = re.compile(r'"type":\s*"(\w+)"')
_SEQ: Final = re.compile(r'"seq":\s*(\d+)')


@dataclass(frozen=True)
class Beat:
    """One frame, new camera or health check.

    `due` is when it was sent, or would have been if the service had been reachable (monotonic seconds). `wait_s` is the
    time until the answer to it or to a later one of its kind. It is `answered` if it has an answer of its own.
    """

    due: float
    wait_s: float
    answered: bool


@dataclass
class Observation:
    """Everything that was measured. `memory` are times and MB. `ended` is when the service announced its end, if so.

    `late_s` is by how much the observer itself was late at worst. `refusals` count failed attempts by their reasons.
    """

    frames: list[Beat] = field(default_factory=list)
    newcomers: list[Beat] = field(default_factory=list)
    health: list[Beat] = field(default_factory=list)
    memory: list[tuple[float, float]] = field(default_factory=list)
    refusals: Counter[str] = field(default_factory=Counter)
    late_s: float = 0.0
    ended: float | None = None
    killed: bool = False


class ObserverError(RuntimeError):
    """The observer failed, or the service did not answer before the attack."""


class Observer:
    """The process that observes, seen from outside."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe

    def finish(self) -> Observation:
        """Ends the observation and returns it."""
        self._pipe.send(None)
        if not self._pipe.poll(_FINISH_S):
            raise ObserverError("the observer did not end in time")
        observation = self._pipe.recv()
        if not isinstance(observation, Observation):
            raise ObserverError(str(observation))
        return observation


@contextmanager
def observer(target: Target, jpegs: Sequence[bytes], cameras: int) -> Iterator[Observer]:
    """Starts the observation of `cameras` cameras that show `jpegs`, and yields when the service has warmed up.

    Raises ObserverError if the cameras get no answers.
    """
    context = get_context("spawn")
    pipe, theirs = context.Pipe()
    process = context.Process(target=_observe, args=(theirs, target, jpegs, cameras), daemon=True)
    process.start()
    theirs.close()
    try:
        message = pipe.recv()
        if message is not None:
            raise ObserverError(message)
        yield Observer(pipe)
    except EOFError:
        raise ObserverError("the observer ended unexpectedly") from None
    finally:
        process.kill()
        process.join()
        pipe.close()


def _observe(pipe: Connection, target: Target, jpegs: Sequence[bytes], cameras: int) -> None:
    """Observes until a message arrives over `pipe`; the target of a process. Sends None when the service is warm."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    observation = Observation()
    threading.Thread(target=_sample_memory, args=(target, observation), daemon=True).start()
    try:
        asyncio.run(_run(pipe, target, jpegs, cameras, observation))
        pipe.send(observation)
    except ObserverError as error:
        pipe.send(str(error))


async def _run(
    pipe: Connection, target: Target, jpegs: Sequence[bytes], cameras: int, observation: Observation
) -> None:
    stop = asyncio.Event()
    observed = [_Camera(target, jpegs, observation, stop) for _ in range(cameras)]
    probes = [
        _Probe(observation.newcomers, _NEWCOMER_S, partial(_stream_once, target, jpegs[0]), observation, stop),
        _Probe(observation.health, _HEALTH_S, partial(_check_health, target), observation, stop),
    ]
    everything: list[_Camera | _Probe] = [*observed, *probes]
    tasks = [asyncio.create_task(camera.run(number / cameras)) for number, camera in enumerate(observed)]
    tasks += [asyncio.create_task(probe.run()) for probe in probes]
    try:
        await _wait_for(lambda: all(camera.answers >= _WARM_ANSWERS for camera in observed), _WARM_S)
        if any(camera.answers < _WARM_ANSWERS for camera in observed):
            raise ObserverError(f"a normal camera got no answers before the attack: {dict(observation.refusals)}")
        pipe.send(None)
        await asyncio.to_thread(pipe.recv)
        stop.set()
        await _wait_for(lambda: not any(each.is_waiting for each in everything), _LAST_ANSWERS_S)
    finally:
        for task in tasks:
            task.cancel()
        ends = await asyncio.gather(*tasks, return_exceptions=True)
    for end in ends:
        if isinstance(end, Exception):
            raise ObserverError(f"the observer failed: {end!r}")
    for each in everything:
        each.give_up()


async def _wait_for(condition: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        await asyncio.sleep(0.02)


class _Camera:
    """A camera in mode `latest`. It connects again whenever it loses its connection."""

    def __init__(self, target: Target, jpegs: Sequence[bytes], observation: Observation, stop: asyncio.Event) -> None:
        self._target = target
        self._jpegs = jpegs
        self._observation = observation
        self._stop = stop
        # The numbers of frames without an answer to them or to a later one, and when they were due.
        self._pending: deque[tuple[int, float]] = deque()
        self._newest = asyncio.Event()
        self.answers = 0

    @property
    def is_waiting(self) -> bool:
        """Whether an answer is missing."""
        return bool(self._pending)

    async def run(self, phase: float) -> None:
        """Takes frames and streams them until it is cancelled. `phase` is when it begins, in periods of a frame."""
        streaming = asyncio.create_task(self._stream())
        try:
            seqs = count()
            async for due in _ticks(_FRAME_S, self._stop, phase):
                self._observation.late_s = max(self._observation.late_s, time.monotonic() - due)
                self._pending.append((next(seqs), due))
                self._newest.set()
            await streaming
        finally:
            streaming.cancel()

    def give_up(self) -> None:
        """Counts the frames that are still without an answer."""
        now = time.monotonic()
        if self._observation.ended is None:
            self._observation.frames.extend(Beat(due, now - due, answered=False) for _, due in self._pending)

    async def _stream(self) -> None:
        while True:
            try:
                async with _connected(self._target) as socket:
                    await socket.send('{"type": "start", "mode": "latest"}')
                    sending = asyncio.create_task(self._send(socket))
                    try:
                        async for message in socket:
                            self._receive(str(message))
                    finally:
                        sending.cancel()
                self._observation.refusals[f"closed with {socket.close_code}"] += 1
            except (OSError, TimeoutError, WebSocketException) as error:
                self._observation.refusals[_reason(error)] += 1
            await asyncio.sleep(_RECONNECT_S)

    async def _send(self, socket: ClientConnection) -> None:
        """Sends the newest frame whenever the service has taken the previous one."""
        with suppress(WebSocketException):
            while True:
                await self._newest.wait()
                self._newest.clear()
                seq, due = self._pending[-1]
                await socket.send(f'{{"type": "frame", "seq": {seq}, "timestamp": {due}}}')
                await socket.send(self._jpegs[seq % len(self._jpegs)])

    def _receive(self, message: str) -> None:
        kind, seq = _TYPE.search(message), _SEQ.search(message)
        if kind is None or kind[1] == "ready":
            return
        if kind[1] == "draining":
            # The frames before are still answered; a normal camera goes to another service now.
            self._observation.ended = self._observation.ended or time.monotonic()
            self._stop.set()
        elif kind[1] == "lanes" and seq is not None:
            self.answers += 1
            self._answered(int(seq[1]))
        else:
            self._observation.refusals[message[:100]] += 1

    def _answered(self, seq: int) -> None:
        now = time.monotonic()
        while self._pending and self._pending[0][0] <= seq:
            number, due = self._pending.popleft()
            self._observation.frames.append(Beat(due, now - due, answered=number == seq))


class _Probe:
    """Tries something regularly, again and again until it succeeds. `attempt` returns when it has succeeded."""

    def __init__(
        self,
        beats: list[Beat],
        period_s: float,
        attempt: Callable[[], Awaitable[float]],
        observation: Observation,
        stop: asyncio.Event,
    ) -> None:
        self._beats = beats
        self._period_s = period_s
        self._attempt = attempt
        self._observation = observation
        self._stop = stop
        self._due: float | None = None

    @property
    def is_waiting(self) -> bool:
        """Whether an attempt is running."""
        return self._due is not None

    async def run(self) -> None:
        """Runs until the end of the observation."""
        async for due in _ticks(self._period_s, self._stop):
            self._due = due
            self._beats.append(Beat(due, await self._success() - due, answered=True))
            self._due = None

    def give_up(self) -> None:
        """Counts an attempt that has not succeeded."""
        if self._due is not None and self._observation.ended is None:
            self._beats.append(Beat(self._due, time.monotonic() - self._due, answered=False))

    async def _success(self) -> float:
        while True:
            try:
                async with asyncio.timeout(_ATTEMPT_S):
                    return await self._attempt()
            except (OSError, TimeoutError, WebSocketException) as error:
                self._observation.refusals[_reason(error)] += 1
            await asyncio.sleep(_RETRY_S)


async def _ticks(period_s: float, stop: asyncio.Event, phase: float = 0.0) -> AsyncIterator[float]:
    """Yields the times of a regular clock until `stop`; those that were missed, too."""
    began = time.monotonic() + phase * period_s
    for number in count():
        due = began + number * period_s
        await asyncio.sleep(max(0.0, due - time.monotonic()))
        if stop.is_set():
            return
        yield due


async def _stream_once(target: Target, jpeg: bytes) -> float:
    """Opens a stream, sends a frame and returns when its answer arrived."""
    async with _connected(target) as socket:
        await socket.send(jpeg)
        message = str(await socket.recv())
        kind = _TYPE.search(message)
        if kind is None or kind[1] != "lanes":
            raise ConnectionRefusedError(f"a new camera got {message[:100]}")
        return time.monotonic()


async def _check_health(target: Target) -> float:
    """Requests /healthz over a fresh connection and returns when its answer arrived."""
    reader, writer = await asyncio.open_connection(target.host, target.port, ssl=target.tls)
    try:
        writer.write(head("GET", "/healthz", ("Connection", "close")) + b"\r\n")
        line = await reader.readline()
        if b" 200 " not in line:
            raise ConnectionRefusedError(f"/healthz: {line.decode().strip() or 'closed'}")
        return time.monotonic()
    finally:
        writer.close()


@asynccontextmanager
async def _connected(target: Target) -> AsyncIterator[ClientConnection]:
    """Opens a stream. It is aborted, not closed, at an error: closing waits for a service that may be stuck."""
    async with connect(
        f"{target.url.replace('http', 'ws')}/v1/stream",
        ssl=target.tls,
        subprotocols=[Subprotocol("lanestream.v1")],
        additional_headers={"Authorization": f"Bearer {target.camera_key}"},
        compression=None,
        max_size=None,
        open_timeout=_ATTEMPT_S,
        close_timeout=_RECONNECT_S,
        proxy=None,
    ) as socket:
        try:
            yield socket
        except BaseException:
            socket.transport.abort()
            raise


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"[:120]


def _sample_memory(target: Target, observation: Observation) -> None:
    """Records the memory of the service until this process ends."""
    while True:
        memory_mb = target.memory_mb()
        observation.memory.append((time.monotonic(), memory_mb))
        if memory_mb > _MOST_MB:
            observation.killed = True
            for process in target.processes():
                with suppress(psutil.NoSuchProcess):
                    process.kill()
        time.sleep(_MEMORY_S)
