"""The workers of a batch on a Ray cluster, by Ray Data: actors with an engine each, which take one unit at a time.

They write their results to the folder of the batch, which all machines must have at the same path. Only the batch
itself records and publishes them, so a unit that Ray runs again does not appear twice.
"""

from __future__ import annotations

import logging
import pickle
import signal
import socket
from collections.abc import Iterator, Sequence
from threading import Event
from typing import TYPE_CHECKING, Any, Final, Self

from lanestream.errors import BatchError, LanestreamError, needs_extra, one_line
from lanestream_client.batch.pool import WorkerPool
from lanestream_client.batch.processing import BatchJob, EngineInfo, UnitProcessor
from lanestream_client.batch.state import UnitResult
from lanestream_client.batch.stopping import STOP_SIGNALS, StopSignals
from lanestream_client.batch.units import Unit
from lanestream_client.batch.worker import Stopped

if TYPE_CHECKING:
    from lanestream_client.batch.pool import ReportUnfinished

_CONNECT_S: Final = 10.0


class RayCluster:
    """Processes units on the cluster at `address`, in at most so many processes; None: one for each of its processors.

    As a context manager it connects to the cluster and disconnects, which ends its actors. Raises BatchError if it
    can't reach a cluster, and MissingExtraError without Ray.
    """

    def __init__(self, job: BatchJob, address: str, processes: int | None, stop: StopSignals) -> None:
        self._job = job
        self._address = address
        self._processes = processes
        self._stop = stop

    def __enter__(self) -> Self:
        with needs_extra("ray"):
            import ray
            import ray.data
        handlers = {number: signal.getsignal(number) for number in STOP_SIGNALS}
        try:
            _check_reachable(self._address)
            with self._stop.interrupting():
                ray.init(self._address, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, OverflowError, RuntimeError, ValueError) as error:
            raise BatchError(
                f"no Ray cluster at {self._address}: {one_line(error)}", "give the address that `ray start` printed"
            ) from None
        for number, handler in handlers.items():  # Ray sets handlers of its own
            signal.signal(number, handler)
        logging.getLogger("ray.data").setLevel(logging.CRITICAL)
        ray.data.DataContext.get_current().enable_progress_bars = False
        return self

    def __exit__(self, *_: object) -> None:
        import ray

        ray.shutdown()

    def start(self) -> EngineInfo | None:
        """Returns what runs in the workers; None if it was stopped. Raises the errors of UnitProcessor."""
        for outcome in self._received(self._description()):
            assert isinstance(outcome, EngineInfo)  # noqa: S101 - what _describe returns
            return outcome
        return None

    def run(self, units: Sequence[Unit], report: ReportUnfinished) -> Iterator[UnitResult]:
        """Yields the outcomes of all units as they come, until it is stopped.

        Raises WriteError, and WorkerLostError if a machine of the cluster can't start workers.
        """
        for outcome in self._received(self._outcomes(units)) if units else ():
            assert isinstance(outcome, UnitResult)  # noqa: S101 - what UnitActor returns
            yield outcome
            report(0.0, 0)

    def _description(self) -> Iterator[EngineInfo | Stopped]:
        import ray

        yield ray.get(ray.remote(_describe).remote(self._job))

    def _outcomes(self, units: Sequence[Unit]) -> Iterator[UnitResult | Stopped]:
        import ray
        import ray.data

        processors = int(ray.cluster_resources().get("CPU", 1))
        most = max(1, min(self._processes or processors, len(units)))
        # With one unit per block, and one block at a time for an actor, no unit waits for another one.
        actors = ray.data.ActorPoolStrategy(min_size=1, max_size=most, max_tasks_in_flight_per_actor=1)
        rows = ray.data.from_items([{"unit": pickle.dumps(unit)} for unit in units], override_num_blocks=len(units))
        outcomes = rows.flat_map(UnitActor, fn_constructor_args=(self._job,), compute=actors, num_cpus=1)
        for row in outcomes.iter_rows():
            yield pickle.loads(row["outcome"])  # noqa: S301 - from an actor of this batch

    def _received(self, outcomes: Iterator[Any]) -> Iterator[Any]:
        """Yields what Ray gives, until the batch is stopped. Raises the error of a worker that can't continue."""
        while True:
            try:
                with self._stop.interrupting():
                    outcome = next(outcomes, None)
            except KeyboardInterrupt:
                return
            except Exception as error:
                raise LanestreamError(f"Ray failed: {type(error).__name__}: {one_line(error)}") from error
            if isinstance(outcome, Stopped):
                raise outcome.error
            if outcome is None:
                return
            yield outcome


class UnitActor:
    """The worker that Ray Data runs: rows with a unit in, rows with its outcomes out.

    It has a pool of one process, so that what a file can do to its worker costs only that file, and Ray restarts an
    actor only if its machine dies.
    """

    def __init__(self, job: BatchJob) -> None:
        self._pool = WorkerPool(job, 1, Event())

    def __call__(self, row: dict[str, bytes]) -> Iterator[dict[str, bytes]]:
        """Yields the rows of the outcomes: a UnitResult each, or Stopped if the worker can't continue."""
        unit: Unit = pickle.loads(row["unit"])  # noqa: S301 - from the batch
        try:
            for result in self._pool.run([unit], lambda *_: None):
                yield {"outcome": pickle.dumps(result)}
        except LanestreamError as error:
            yield {"outcome": pickle.dumps(Stopped(error))}


def _check_reachable(address: str) -> None:
    """Raises OSError if nothing listens at an address with a port, for which Ray itself would wait for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_S).close()


def _describe(job: BatchJob) -> EngineInfo | Stopped:
    """Returns what runs in a worker, or why none can; runs on a machine of the cluster."""
    try:
        return UnitProcessor(job).engine_info
    except LanestreamError as error:
        return Stopped(error)
