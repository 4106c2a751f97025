"""What is measured: cells, in rounds that go through all contestants by turns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from lanestream.protocol import DetectorName

Size = tuple[int, int]

LARGE: Final[Size] = (1280, 720)
SMALL: Final[Size] = (640, 360)

# The pipeline in one process, run as a service of one would run it, and by a plain loop in each thread; and in as many
# processes as the service has.
PIPELINE, LOOP, POOL = "pipeline", "loop", "pool"
SERVICE, NAIVE, LITSERVE = "service", "naive", "litserve"
CONTESTANTS: Final = (PIPELINE, LOOP, POOL, SERVICE, NAIVE, LITSERVE)


@dataclass(frozen=True)
class Cell:
    """One thing that is measured: which contestant, with what load, for how many seconds.

    Every session keeps `in_flight` frames unanswered, sending the next one as an answer comes.
    """

    contestant: str
    size: Size
    sessions: int
    in_flight: int
    seconds: float
    detector: DetectorName = "candidates"


@dataclass(frozen=True)
class Plan:
    """How much is measured. The defaults take about ten minutes on two processors.

    Loads of up to `few` sessions are measured in each of the `rounds`, and so are all of the pipeline and of the
    service. The other contestants meet more sessions in the first round alone, because they take long to get over it.
    In each round clients also push `overload_factor` times as many frames as the service had answered, in mode
    `latest`; at the end the largest number of clients does so for `soak_minutes`. One of the `sizes` is LARGE.
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

    def round(self, number: int) -> list[Cell]:
        """The cells of one round: for each load all contestants in a row, so that a noisy minute is shared by them."""
        return [cell for size in self.sizes for cell in (*self._alone(size), *self._together(size, number))]

    def _alone(self, size: Size) -> list[Cell]:
        """One camera that waits for each answer: the time from a frame to its reply."""
        cells = [Cell(name, size, 1, 1, self.seconds) for name in (SERVICE, NAIVE, LITSERVE)]
        return [*cells, replace(cells[0], detector="regression")]

    def _together(self, size: Size, number: int) -> list[Cell]:
        """As many frames a second as can be had."""
        return [
            Cell(name, size, sessions, 2, self._seconds(name, size))
            for sessions in self.sessions
            for name in CONTESTANTS
            if sessions <= self.few or (number == 0 and name not in (LOOP, POOL)) or name in (PIPELINE, SERVICE)
        ]

    def _seconds(self, name: str, size: Size) -> float:
        return self.compared_seconds if size == LARGE or name == NAIVE else self.seconds


QUICK: Final = Plan(
    rounds=1,
    sizes=(LARGE,),
    sessions=(1, 4, 64),
    seconds=1.0,
    compared_seconds=1.5,
    overload_seconds=3.0,
    soak_minutes=0.1,
)
