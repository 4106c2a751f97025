"""The program of a worker process of a batch: units in, outcomes out, over a pipe."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from dataclasses import dataclass
from queue import SimpleQueue
from typing import TYPE_CHECKING

from lanestream.errors import LanestreamError, one_line
from lanestream_client.batch.processing import BatchJob, UnitProcessor

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

    from lanestream_client.batch.units import Unit


@dataclass(frozen=True)
class Stopped:
    """The worker can't continue, and neither could another one: the engine can't be loaded, or the disk is full."""

    error: LanestreamError


def run_worker(job: BatchJob, pipe: Connection) -> None:
    """Sends an EngineInfo, then a UnitResult for every unit that it receives, with Progress in between.

    Sends Stopped instead if it can't continue. Ends when the other end of the pipe is closed, at any moment.
    """
    units: SimpleQueue[Unit] = SimpleQueue()
    threading.Thread(target=_receive_units, args=(pipe, units), daemon=True).start()
    # The batch has ended if it does not read any more.
    with suppress(BrokenPipeError):
        try:
            processor = UnitProcessor(job)
            pipe.send(processor.engine_info)
            while True:
                pipe.send(processor.process(units.get(), pipe.send))
        except LanestreamError as error:
            pipe.send(Stopped(error))
        except BrokenPipeError:
            raise
        except Exception as error:  # while the engine is loaded; those of files are a part of the outcome
            pipe.send(Stopped(LanestreamError(f"a worker failed: {type(error).__name__}: {one_line(error)}")))


def _receive_units(pipe: Connection, units: SimpleQueue[Unit]) -> None:
    """Receives units until the batch has ended, and ends the process then, even in the middle of a unit."""
    with suppress(EOFError, OSError):
        while True:
            units.put(pipe.recv())
    os._exit(0)
