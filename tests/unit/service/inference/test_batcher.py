"""Questions of many cameras, answered together. The networks are fakes, the thread is real."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import fakes
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lanestream.detection import Question
from lanestream.errors import ExpiredError
from lanestream.inference.batcher import Batcher, BatchQueue, BatchReport, Waiting


class Sums(fakes.FakeNetwork):
    """Answers each input with the sum of its pixels; fails at a batch with an input of 255; remembers its batches.

    `threads` are those that they ran in, and `together` is how many ran at once at most.
    """

    def __init__(self) -> None:
        self.batches: list[int] = []
        self.threads: list[str] = []
        self.may_run = threading.Event()
        self.may_run.set()
        self.together = self._running = 0

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self._running += 1
        self.together = max(self.together, self._running)
        try:
            assert self.may_run.wait(fakes.WAIT_S)
            return self._sums(inputs)
        finally:
            self._running -= 1

    def _sums(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.batches.append(len(inputs))
        self.threads.append(threading.current_thread().name)
        if len(inputs) and inputs.max() == 255:
            raise RuntimeError("poison")
        return inputs.reshape(len(inputs), 1).astype(np.float32)


def question(network: fakes.FakeNetwork, *values: int) -> Question:
    return Question(network, np.array(values, np.uint8).reshape(-1, 1, 1, 1))


def waiting(network: fakes.FakeNetwork, rows: int, deadline: float | None = None) -> Waiting:
    return Waiting(question(network, *range(rows)), 0.0, deadline)


def rows(batch: list[Waiting]) -> list[int]:
    return [each.rows for each in batch]


def test_what_fits_into_one_run_goes_together_in_the_order_it_came() -> None:
    queue, network = BatchQueue(), Sums()
    for count in (7, 6, 4, 3, 16):
        queue.add(waiting(network, count))
    taken = [rows(queue.take(0.0)[0]) for _ in range(4)]
    assert taken == [[7, 6, 3], [4], [16], []]


def test_one_run_is_of_one_network_and_the_oldest_question_chooses_it() -> None:
    queue, one, other = BatchQueue(), Sums(), Sums()
    for network in (other, one, other, one):
        queue.add(waiting(network, 2))
    first, second = queue.take(0.0)[0], queue.take(0.0)[0]
    assert {each.question.network for each in first} == {other}
    assert {each.question.network for each in second} == {one}
    assert len(first) == len(second) == 2


def test_a_question_larger_than_any_batch_goes_alone() -> None:
    queue, network = BatchQueue(), Sums()
    queue.add(waiting(network, 40))
    queue.add(waiting(network, 1))
    assert rows(queue.take(0.0)[0]) == [40]
    assert rows(queue.take(0.0)[0]) == [1]


def test_expired_questions_are_told_apart_and_never_run() -> None:
    queue, network = BatchQueue(), Sums()
    queue.add(waiting(network, 1, deadline=5.0))
    queue.add(waiting(network, 2, deadline=7.0))
    queue.add(waiting(network, 3))
    batch, expired = queue.take(6.0)
    assert rows(expired) == [1]
    assert rows(batch) == [2, 3]
    assert len(queue) == 0


@given(st.lists(st.integers(0, 20), max_size=40))
def test_every_question_is_taken_once_and_no_run_is_too_large(sizes: list[int]) -> None:
    queue, network = BatchQueue(), Sums()
    for size in sizes:
        queue.add(waiting(network, size))
    taken: list[int] = []
    while len(queue):
        batch, _ = queue.take(0.0)
        assert sum(rows(batch)) <= max(16, batch[0].rows)
        taken += rows(batch)
    assert sorted(taken) == sorted(sizes)


def test_each_gets_the_rows_it_asked_for() -> None:
    reports: list[BatchReport] = []
    network, batcher = Sums(), Batcher(reports.append)
    network.may_run.clear()
    first = batcher.ask(question(network, 1))
    others = [batcher.ask(question(network, *values)) for values in ((2, 3), (), (4,))]
    network.may_run.set()
    assert first.result(fakes.WAIT_S).outputs.ravel().tolist() == [1]
    assert [other.result(fakes.WAIT_S).outputs.ravel().tolist() for other in others] == [[2, 3], [], [4]]
    batcher.close()
    assert sum(report.questions for report in reports) == 4
    assert sum(report.rows for report in reports) == 4
    assert sum(network.batches) == 4


def test_who_waits_runs_an_idle_network_itself() -> None:
    reports: list[BatchReport] = []
    network, batcher = Sums(), Batcher(reports.append)
    assert batcher.answer(question(network, 1, 2)).outputs.ravel().tolist() == [1, 2]
    with pytest.raises(RuntimeError, match="poison"):
        batcher.answer(question(network, 255))
    with pytest.raises(ExpiredError):
        batcher.answer(question(network, 3), deadline=0.0)
    assert network.batches == [2, 1]
    assert set(network.threads) == {threading.current_thread().name}
    assert batcher.ask(question(network, 9)).result(fakes.WAIT_S).outputs.tolist() == [[9]], "the thread works too"
    batcher.close()
    assert [report.rows for report in reports] == [2, 1]
    with pytest.raises(RuntimeError, match="closed"):
        batcher.answer(question(network, 1))


def test_one_run_at_a_time_whoever_does_it() -> None:
    network, batcher = Sums(), Batcher()
    network.may_run.clear()
    with ThreadPoolExecutor(4) as askers:
        answers = [askers.submit(batcher.answer, question(network, value)) for value in range(4)]
        asked = [batcher.ask(question(network, value)) for value in range(4, 6)]
        assert not any(each.done() for each in answers)
        network.may_run.set()
        found = [each.result(fakes.WAIT_S).outputs.item() for each in answers]
    assert found == [0, 1, 2, 3]
    assert [each.result(fakes.WAIT_S).outputs.item() for each in asked] == [4, 5]
    batcher.close()
    assert network.together == 1
    assert sum(network.batches) == 6


def test_a_poisoned_question_fails_alone() -> None:
    network, batcher = Sums(), Batcher()
    network.may_run.clear()
    head = batcher.ask(question(network, 0))
    good, bad, other = (batcher.ask(question(network, *values)) for values in ((1, 2), (255,), (3,)))
    network.may_run.set()
    assert head.result(fakes.WAIT_S).outputs.shape == (1, 1)
    assert good.result(fakes.WAIT_S).outputs.ravel().tolist() == [1, 2]
    assert other.result(fakes.WAIT_S).outputs.ravel().tolist() == [3]
    with pytest.raises(RuntimeError, match="poison"):
        bad.result(fakes.WAIT_S)
    assert batcher.ask(question(network, 9)).result(fakes.WAIT_S).outputs.tolist() == [[9]], "the thread lives on"
    batcher.close()


def test_expired_and_unwanted_questions_cost_no_run() -> None:
    network, batcher = Sums(), Batcher()
    network.may_run.clear()
    head = batcher.ask(question(network, 0))
    unwanted = batcher.ask(question(network, 1))
    expired = batcher.ask(question(network, 2), deadline=0.0)
    assert unwanted.cancel()
    network.may_run.set()
    with pytest.raises(ExpiredError):
        expired.result(fakes.WAIT_S)
    head.result(fakes.WAIT_S)
    batcher.close()
    assert network.batches == [1]


def test_closing_answers_what_waits_and_takes_no_more() -> None:
    network, batcher = Sums(), Batcher()
    network.may_run.clear()
    asked = [batcher.ask(question(network, value)) for value in range(5)]
    network.may_run.set()
    batcher.close()
    assert [each.result(0).outputs.item() for each in asked] == [0, 1, 2, 3, 4]
    with pytest.raises(RuntimeError, match="closed"):
        batcher.ask(question(network, 1))
