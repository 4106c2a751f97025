"""The batcher: runs the inference requests of many cameras together, one batch at a time.

It is work-conserving: when the device is free it runs what is waiting, up to the model's largest batch, and never waits
for more requests, so batching costs a single camera nothing. A camera has one request at a time, so first come, first
served is fair between cameras.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lanestream.errors import ExpiredError

_log = logging.getLogger(__name__)


class RunnableModel(Protocol):
    """What the batcher needs of a model; `lanestream.inference.loaded_model.LoadedModel` is one."""

    @property
    def name(self) -> str:
        """The model's name and version."""

    @property
    def largest_batch(self) -> int:
        """The most inputs of one run."""

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns outputs (N, outputs) for inputs (N, size, size, 3)."""


@dataclass(frozen=True)
class InferenceResult:
    """A model's outputs (N, outputs), and when the run that computed them began and ended (monotonic seconds)."""

    outputs: NDArray[np.float32]
    started: float
    ended: float


@dataclass(frozen=True, eq=False)
class InferenceRequest:
    """Inputs (N, size, size, 3) for a model, and the future of its result.

    After `deadline` (monotonic seconds) the result is no longer needed.
    """

    model: RunnableModel
    inputs: NDArray[np.uint8]
    submitted: float
    deadline: float | None
    future: Future[InferenceResult] = field(default_factory=Future)


@dataclass(frozen=True)
class BatchReport:
    """One run: its model, inputs and requests, the requests still waiting, and the longest wait in it (seconds)."""

    model: str
    inputs: int
    requests: int
    still_waiting: int
    longest_wait_s: float


class RequestQueue:
    """Waiting requests in the order of their arrival. Not thread-safe; reads no clock."""

    def __init__(self) -> None:
        self._waiting: deque[InferenceRequest] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, request: InferenceRequest) -> None:
        """Adds a request."""
        self._waiting.append(request)

    def take(self, now: float) -> tuple[list[InferenceRequest], list[InferenceRequest]]:
        """Removes and returns the next batch, all of one model, and the requests that have expired.

        The oldest request chooses the model; later ones of that model join it, in order, while they fit.
        """
        expired = [each for each in self._waiting if each.deadline is not None and each.deadline < now]
        valid = deque(each for each in self._waiting if each not in expired)
        self._waiting = deque()
        if not valid:
            return [], expired
        batch = [valid.popleft()]
        model, inputs = batch[0].model, len(batch[0].inputs)
        for each in valid:
            if each.model is model and inputs + len(each.inputs) <= model.largest_batch:
                batch.append(each)
                inputs += len(each.inputs)
            else:
                self._waiting.append(each)
        return batch, expired


@dataclass(frozen=True)
class _Batch:
    """The requests of one run, those that expired before it, and the number that still wait."""

    requests: list[InferenceRequest]
    expired: list[InferenceRequest]
    still_waiting: int


class Batcher:
    """Runs requests in its own thread or in that of a waiting caller. `observe`, if given, gets a report of every run.

    Models may run in any thread; the batcher runs one batch at a time.
    """

    def __init__(self, observe: Callable[[BatchReport], None] | None = None) -> None:
        self._observe = observe
        self._queue = RequestQueue()
        self._changed = threading.Condition()
        self._running = False
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="lanestream-inference", daemon=True)
        self._thread.start()

    def submit(
        self, model: RunnableModel, inputs: NDArray[np.uint8], deadline: float | None = None
    ) -> Future[InferenceResult]:
        """Returns the future result, which fails with ExpiredError if `deadline` (monotonic seconds) passes before.

        Raises RuntimeError after `close`.
        """
        with self._changed:
            request = self._add(model, inputs, deadline)
            if not self._running:
                self._changed.notify()
        return request.future

    def run(self, model: RunnableModel, inputs: NDArray[np.uint8], deadline: float | None = None) -> InferenceResult:
        """Submits a request and waits for its result.

        If no batch is running, the caller's thread runs the waiting requests itself, which is faster than waking
        another thread and waiting for it. Raises ExpiredError if `deadline` passes before the run, and RuntimeError
        after `close`.
        """
        with self._changed:
            request = self._add(model, inputs, deadline)
            batch = None if self._running else self._take()
        if batch is not None:
            self._run(batch)
        return request.future.result()

    def close(self) -> None:
        """Ends the thread after all waiting requests have run."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _add(self, model: RunnableModel, inputs: NDArray[np.uint8], deadline: float | None) -> InferenceRequest:
        if self._closed:
            raise RuntimeError("the batcher is closed")
        request = InferenceRequest(model, inputs, time.monotonic(), deadline)
        self._queue.add(request)
        return request

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: not self._running and (self._closed or len(self._queue) > 0))
                if not len(self._queue):
                    return
                batch = self._take()
            self._run(batch)

    def _take(self) -> _Batch:
        """Returns the next batch, which the caller has to run."""
        requests, expired = self._queue.take(time.monotonic())
        self._running = True
        return _Batch(requests, expired, len(self._queue))

    def _run(self, batch: _Batch) -> None:
        try:
            for request in batch.expired:
                _fail(request, ExpiredError())
            # Callers that went away have canceled their requests; after this line they can't.
            wanted = [request for request in batch.requests if request.future.set_running_or_notify_cancel()]
            if wanted:
                self._run_requests(wanted, batch.still_waiting)
        except BaseException as error:
            # Whatever failed, callers must not wait forever, and later batches have to run.
            _log.exception("a batch of %d requests failed", len(batch.requests))
            for request in (*batch.expired, *batch.requests):
                _fail(request, error)
        finally:
            with self._changed:
                self._running = False
                if self._closed or len(self._queue):
                    self._changed.notify()

    def _run_requests(self, requests: list[InferenceRequest], still_waiting: int) -> None:
        started = time.monotonic()
        model = requests[0].model
        inputs = [request.inputs for request in requests]
        try:
            outputs = model.run(inputs[0] if len(inputs) == 1 else np.concatenate(inputs))
            parts = np.split(outputs, np.cumsum([len(part) for part in inputs])[:-1])
        except Exception as error:
            if len(requests) == 1:
                requests[0].future.set_exception(error)
            else:
                _log.warning("a batch of %d requests failed; running each one separately: %s", len(requests), error)
                for request in requests:
                    self._run_requests([request], still_waiting)
            return
        ended = time.monotonic()
        for request, part in zip(requests, parts, strict=True):
            request.future.set_result(InferenceResult(part, started, ended))
        if self._observe is not None:
            longest_wait = started - min(request.submitted for request in requests)
            self._observe(BatchReport(model.name, len(outputs), len(requests), still_waiting, longest_wait))


def _fail(request: InferenceRequest, error: BaseException) -> None:
    """Answers a request with an error, unless it was answered or canceled before."""
    with suppress(InvalidStateError):
        request.future.set_exception(error)
