"""What the main process orders from its helpers, the load generators and the pipeline in process, over pipes."""

from __future__ import annotations

from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, Literal

from bench.plan import Size
from lanestream.protocol import DetectorName

Kind = Literal["lanestream", "bare", "http", "pipeline", "loop", "pool"]


@dataclass(frozen=True)
class Order:
    """A load: how many sessions, and how they send.

    With a `rate` (frames a second, each session) frames are pushed in mode `latest`, whatever comes back; without one
    every session keeps `in_flight` frames unanswered. `kind` tells what `url` speaks: our protocol, frames and answers
    over a bare WebSocket, or HTTP; without one, which way the pipeline in process runs.
    """

    size: Size
    sessions: int
    in_flight: int = 1
    rate: float | None = None
    detector: DetectorName = "candidates"
    kind: Kind = "lanestream"
    url: str = ""


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a frame: of which session of the helper, and when it was sent and answered (monotonic seconds)."""

    session: int
    sent: float
    answered: float


@dataclass
class Tally:
    """What came back to a helper."""

    answers: list[Answer] = field(default_factory=list)
    failed: int = 0


class Helper:
    """The main process's end of a helper: it is sent an order, says `settled`, is told to stop, and sends a Tally."""

    def __init__(self, process: SpawnProcess, pipe: Connection) -> None:
        self._process = process
        self._pipe = pipe

    @property
    def pid(self) -> int:
        """The process's number."""
        assert self._process.pid is not None  # noqa: S101 - it was started
        return self._process.pid

    def begin(self, order: Order) -> None:
        """Starts a load."""
        self._pipe.send(order)

    def wait_until_settled(self, seconds: float) -> bool:
        """Whether every session had an answer within so many seconds. Raises RuntimeError where a session broke."""
        return self._pipe.poll(max(0.0, seconds)) and self._receive() is None

    def stop(self) -> Tally:
        """Ends the load; all answers that it had, those from before it was settled too."""
        self._pipe.send(None)
        while (told := self._receive()) is None:
            pass
        assert isinstance(told, Tally)  # noqa: S101 - what helpers send
        return told

    def hello(self) -> Any:
        """The helper's first word, sent when it is ready."""
        return self._receive()

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.join()

    def _receive(self) -> Any:
        try:
            told = self._pipe.recv()
        except EOFError:
            raise RuntimeError("a helper process died") from None
        if isinstance(told, str):
            raise RuntimeError(told)
        return told
