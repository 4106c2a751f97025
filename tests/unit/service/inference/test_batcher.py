"""The batcher: requests of many cameras in one run. The models are fakes, the threads are real."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import fakes
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lanestream.errors import ExpiredError
from lanestream.inference.batcher import Batcher, BatchReport, InferenceRequest, InferenceResult, RequestQueue


class SumModel(fakes.FakeModel):
    """Returns the sum of each input's pixels; fails on a batch that contains an input of 255.

    Records the size of each batch, the thread that ran it, and the most runs at the same time.
    """

    def __init__(self) -> None:
        self.batches: list[int] = []
        self.threads: list[str] = []
        self.may_run = threading.Event()
        self.may_run.set()
        self.most_parallel = self._running = 0

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self._running += 1
        self.most_parallel = max(self.most_parallel, self._running)
        try:
            assert self.may_run.wait(fakes.WAIT_S)
            return self._sums(inputs)
        finally:
            self._running -= 1

    def _sums(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.batches.append(len(inputs))
        self.threads.append(threading.current_thread().name)
        if len(inputs) and inputs.max() == 255:
            raise RuntimeError("the input is 255")
        return inputs.reshape(len(inputs), 1).astype(np.float32)


def inputs_of(*values: int) -> NDArray[np.uint8]:
    return np.array(values, np.uint8).reshape(-1, 1, 1, 1)


def request(model: fakes.FakeModel, inputs: int, deadline: float | None = None) -> InferenceRequest:
    return InferenceRequest(model, inputs_of(*range(inputs)), 0.0, deadline)


def sizes_of(requests: list[InferenceRequest]) -> list[int]:
    return [len(each.inputs) for each in requests]


def sums(result: InferenceResult) -> list[float]:
    values: list[float] = result.outputs.ravel().tolist()
    return values


def test_requests_that_fit_into_one_run_are_batched_in_the_order_of_their_arrival() -> None:
    queue, model = RequestQueue(), SumModel()
    for inputs in (7, 6, 4, 3, 16):
        queue.add(request(model, inputs))
    batches = [sizes_of(queue.take(0.0)[0]) for _ in range(4)]
    assert batches == [[7, 6, 3], [4], [16], []]


def test_a_batch_has_one_model_which_the_oldest_request_chooses() -> None:
    queue, one, other = RequestQueue(), SumModel(), SumModel()
    for model in (other, one, other, one):
        queue.add(request(model, 2))
    first, second = queue.take(0.0)[0], queue.take(0.0)[0]
    assert {each.model for each in first} == {other}
    assert {each.model for each in second} == {one}
    assert len(first) == len(second) == 2


def test_a_request_larger_than_the_largest_batch_runs_alone() -> None:
    queue, model = RequestQueue(), SumModel()
    queue.add(request(model, 40))
    queue.add(request(model, 1))
    assert sizes_of(queue.take(0.0)[0]) == [40]
    assert sizes_of(queue.take(0.0)[0]) == [1]


def test_expired_requests_are_returned_apart_from_the_batch() -> None:
    queue, model = RequestQueue(), SumModel()
    queue.add(request(model, 1, deadline=5.0))
    queue.add(request(model, 2, deadline=7.0))
    queue.add(request(model, 3))
    batch, expired = queue.take(6.0)
    assert sizes_of(expired) == [1]
    assert sizes_of(batch) == [2, 3]
    assert len(queue) == 0


@given(st.lists(st.integers(0, 20), max_size=40))
def test_every_request_is_taken_once_and_no_batch_is_too_large(sizes: list[int]) -> None:
    queue, model = RequestQueue(), SumModel()
    for size in sizes:
        queue.add(request(model, size))
    taken: list[int] = []
    while len(queue):
        batch = sizes_of(queue.take(0.0)[0])
        assert sum(batch) <= max(model.largest_batch, batch[0])
        taken += batch
    assert sorted(taken) == sorted(sizes)


def test_each_request_gets_the_outputs_of_its_own_inputs() -> None:
    reports: list[BatchReport] = []
    model, batcher = SumModel(), Batcher(reports.append)
    model.may_run.clear()
    first = batcher.submit(model, inputs_of(1))
    others = [batcher.submit(model, inputs_of(*values)) for values in ((2, 3), (), (4,))]
    model.may_run.set()
    assert sums(first.result(fakes.WAIT_S)) == [1]
    assert [sums(other.result(fakes.WAIT_S)) for other in others] == [[2, 3], [], [4]]
    batcher.close()
    assert sum(report.requests for report in reports) == 4
    assert sum(report.inputs for report in reports) == 4
    assert sum(model.batches) == 4


def test_a_result_says_when_its_run_began_and_ended() -> None:
    batcher = Batcher()
    result = batcher.run(SumModel(), inputs_of(1))
    assert 0.0 <= result.ended - result.started < fakes.WAIT_S
    batcher.close()


def test_a_caller_that_waits_runs_an_idle_model_itself() -> None:
    reports: list[BatchReport] = []
    model, batcher = SumModel(), Batcher(reports.append)
    assert sums(batcher.run(model, inputs_of(1, 2))) == [1, 2]
    with pytest.raises(RuntimeError, match="the input is 255"):
        batcher.run(model, inputs_of(255))
    with pytest.raises(ExpiredError):
        batcher.run(model, inputs_of(3), deadline=0.0)
    assert model.batches == [2, 1]
    assert set(model.threads) == {threading.current_thread().name}
    assert sums(batcher.submit(model, inputs_of(9)).result(fakes.WAIT_S)) == [9], "the batcher's thread works too"
    batcher.close()
    assert [report.inputs for report in reports] == [2, 1]
    with pytest.raises(RuntimeError, match="closed"):
        batcher.run(model, inputs_of(1))


def test_batches_run_one_at_a_time_in_any_thread() -> None:
    model, batcher = SumModel(), Batcher()
    model.may_run.clear()
    with ThreadPoolExecutor(4) as callers:
        called = [callers.submit(batcher.run, model, inputs_of(value)) for value in range(4)]
        submitted = [batcher.submit(model, inputs_of(value)) for value in range(4, 6)]
        assert not any(each.done() for each in called)
        model.may_run.set()
        found = [sums(each.result(fakes.WAIT_S)) for each in called]
    assert found == [[0], [1], [2], [3]]
    assert [sums(each.result(fakes.WAIT_S)) for each in submitted] == [[4], [5]]
    batcher.close()
    assert model.most_parallel == 1
    assert sum(model.batches) == 6


def test_a_request_that_makes_a_batch_fail_fails_alone() -> None:
    model, batcher = SumModel(), Batcher()
    model.may_run.clear()
    first = batcher.submit(model, inputs_of(0))
    good, bad, other = (batcher.submit(model, inputs_of(*values)) for values in ((1, 2), (255,), (3,)))
    model.may_run.set()
    assert first.result(fakes.WAIT_S).outputs.shape == (1, 1)
    assert sums(good.result(fakes.WAIT_S)) == [1, 2]
    assert sums(other.result(fakes.WAIT_S)) == [3]
    with pytest.raises(RuntimeError, match="the input is 255"):
        bad.result(fakes.WAIT_S)
    assert sums(batcher.submit(model, inputs_of(9)).result(fakes.WAIT_S)) == [9], "the batcher's thread still works"
    batcher.close()


def test_expired_and_canceled_requests_are_never_run() -> None:
    model, batcher = SumModel(), Batcher()
    model.may_run.clear()
    first = batcher.submit(model, inputs_of(0))
    canceled = batcher.submit(model, inputs_of(1))
    expired = batcher.submit(model, inputs_of(2), deadline=0.0)
    assert canceled.cancel()
    model.may_run.set()
    with pytest.raises(ExpiredError):
        expired.result(fakes.WAIT_S)
    first.result(fakes.WAIT_S)
    batcher.close()
    assert model.batches == [1]


def test_close_runs_what_waits_and_accepts_no_more() -> None:
    model, batcher = SumModel(), Batcher()
    model.may_run.clear()
    submitted = [batcher.submit(model, inputs_of(value)) for value in range(5)]
    model.may_run.set()
    batcher.close()
    assert [sums(each.result(0)) for each in submitted] == [[0], [1], [2], [3], [4]]
    with pytest.raises(RuntimeError, match="closed"):
        batcher.submit(model, inputs_of(1))


class BrokenModel(fakes.FakeModel):
    """Fails in ways in which no model should fail."""

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        match int(inputs[0, 0, 0, 0]):
            case 1:
                return None  # type: ignore[return-value]
            case 2:
                raise SystemExit("a library ends the thread")
            case _:
                return super().run(inputs)


@pytest.mark.parametrize(("value", "error"), [(1, Exception), (2, SystemExit)])
def test_the_thread_survives_whatever_a_model_does(value: int, error: type[BaseException]) -> None:
    model, batcher = BrokenModel(), Batcher()
    with pytest.raises(error):
        batcher.submit(model, inputs_of(value)).result(fakes.WAIT_S)
    assert batcher.submit(model, inputs_of(0)).result(fakes.WAIT_S).outputs.shape == (1, 2)
    with pytest.raises(error):
        batcher.run(model, inputs_of(value))
    batcher.close()


def test_every_request_of_a_batch_that_ends_its_thread_gets_the_error(caplog: pytest.LogCaptureFixture) -> None:
    first, model, batcher = SumModel(), BrokenModel(), Batcher()
    first.may_run.clear()
    submitted = [batcher.submit(first, inputs_of(0)), *(batcher.submit(model, inputs_of(2)) for _ in range(3))]
    first.may_run.set()
    for each in submitted[1:]:
        with pytest.raises(SystemExit):
            each.result(fakes.WAIT_S)
    batcher.close()
    assert "a batch of 3 requests failed" in caplog.text
    assert "a library ends the thread" in caplog.text


def test_an_observer_that_fails_loses_no_result(caplog: pytest.LogCaptureFixture) -> None:
    def observe(_: BatchReport) -> None:
        raise ValueError("the observer failed")

    model, batcher = SumModel(), Batcher(observe)
    assert [sums(batcher.submit(model, inputs_of(n)).result(fakes.WAIT_S)) for n in range(3)] == [[0], [1], [2]]
    assert sums(batcher.run(model, inputs_of(3))) == [3]
    batcher.close()
    assert "the observer failed" in caplog.text
