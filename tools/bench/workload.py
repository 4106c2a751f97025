"""What the benchmark measures: workloads, in rounds that go through all runners, and the replies that they get."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final, Literal

from lanestream.protocol import DetectorName

Size = tuple[int, int]

LARGE: Final[Size] = (1280, 720)
SMALL: Final[Size] = (640, 360)

# The in-process runners: with the service's threads and batches in one process, as a plain loop in each thread, and
# with as many worker processes as the service has.
PIPELINE, LOOP, POOL = "pipeline", "loop", "pool"
# The runners that are servers.
SERVICE, BASELINE, LITSERVE = "service", "baseline", "litserve"
IN_PROCESS: Final = (PIPELINE, LOOP, POOL)
RUNNERS: Final = (*IN_PROCESS, SERVICE, BASELINE, LITSERVE)

# What a server speaks: our protocol, image files and replies over a plain WebSocket, or HTTP.
Transport = Literal["lanestream", "websocket", "http"]


@dataclass(frozen=True)
class Workload:
    """One measurement: a runner under a load for some seconds.

    Every session keeps `in_flight` frames unanswered: it sends the next one when a reply arrives.
    """

    runner: str
    size: Size
    sessions: int
    in_flight: int
    seconds: float
    detector: DetectorName = "candidates"


@dataclass(frozen=True)
class Suite:
    """All workloads of a benchmark. The defaults take about ten minutes on two processors.

    Every runner gets the loads of up to `few` sessions in each of the `rounds`; the pipeline and the service get all
    loads in each round. The other runners get the loads of more sessions in the first round only, because they need
    long to recover from them. In each round, clients also push `overload_factor` times as many frames as the service
    answered, in mode `latest`. At the end the largest number of clients does so for `soak_minutes`. LARGE has to be
    one of the `sizes`.
    """

    rounds: int = 5
    sizes: tuple[Size, ...] = (LARGE, SMALL)
    sessions: tuple[int, ...] = (1, 4, 16, 64)
    few: int = 4
    seconds: float = 1.5
    compared_seconds: float = 3.0
    overload_seconds: float = 4.0
    overload_clients: tuple[int, ...] = (1, 4)
    overload_factor: float = 3.0
    soak_minutes: float = 0.5

    @property
    def compared_sessions(self) -> int:
        """The number of sessions at which runners are compared: the largest that all of them get in every round."""
        return max(sessions for sessions in self.sessions if sessions <= self.few)

    def round(self, number: int) -> list[Workload]:
        """Returns the workloads of a round, all runners one after the other on each load, so that noise hits all."""
        return [workload for size in self.sizes for workload in (*self._latency(size), *self._throughput(size, number))]

    def _latency(self, size: Size) -> list[Workload]:
        """Returns the workloads of one camera that waits for each reply."""
        workloads = [Workload(name, size, 1, 1, self.seconds) for name in (SERVICE, BASELINE, LITSERVE)]
        return [*workloads, replace(workloads[0], detector="regression")]

    def _throughput(self, size: Size, number: int) -> list[Workload]:
        """Returns the workloads with as many frames per second as the runners can answer."""
        return [
            Workload(name, size, sessions, 2, self._seconds(name, size))
            for sessions in self.sessions
            for name in RUNNERS
            if sessions <= self.few or (number == 0 and name not in (LOOP, POOL)) or name in (PIPELINE, SERVICE)
        ]

    def _seconds(self, runner: str, size: Size) -> float:
        return self.compared_seconds if size == LARGE or runner == BASELINE else self.seconds


QUICK: Final = Suite(
    rounds=1,
    sizes=(LARGE,),
    sessions=(1, 4, 64),
    seconds=1.0,
    compared_seconds=1.5,
    overload_seconds=3.0,
    soak_minutes=0.1,
)


@dataclass(frozen=True)
class LoadRequest:
    """What a load generator, or the process with the in-process runners, is asked to do until it is stopped.

    With a `rate` (frames per second of each session) frames are pushed in mode `latest` without waiting for replies;
    without one, every session keeps `in_flight` frames unanswered. A load generator uses `transport` and `url`, the
    process with the in-process runners uses `runner`.
    """

    size: Size
    sessions: int
    in_flight: int = 1
    rate: float | None = None
    detector: DetectorName = "candidates"
    runner: str = SERVICE
    transport: Transport = "lanestream"
    url: str = ""


@dataclass(frozen=True, slots=True)
class Reply:
    """The reply to one frame: its session, and when the frame was sent and answered (monotonic seconds)."""

    session: int
    sent: float
    answered: float


@dataclass
class LoadResult:
    """All replies to a load, and how many of them were errors."""

    replies: list[Reply] = field(default_factory=list)
    failed: int = 0
