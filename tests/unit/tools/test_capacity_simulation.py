"""The simulation against queueing theory, and what must hold for every scenario."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from random import Random
from statistics import mean

import pytest
import simpy
from capacity.calibration import Calibration, ServiceTime
from capacity.load import FrameLife, Load, outcome
from capacity.processor import Processor
from capacity.simulated_camera import Network
from capacity.simulated_node import NodeShape, Process, SimulatedNode, SimulatedStream
from capacity.simulation import Scenario, SimulationResult, simulate

from lanestream.protocol import Mode

SERVICE_S = 0.02


def calibration(worker_s: Sequence[float], loop_s: float = 0.0, wait_s: float = 0.0) -> Calibration:
    return Calibration(tuple(ServiceTime(loop_s, each, wait_s, 0.0) for each in worker_s), open_s=0.005, save_s=0.0)


CONSTANT = calibration([SERVICE_S])
# The middles of a thousand equally likely intervals.
EXPONENTIAL = calibration([-SERVICE_S * math.log(1.0 - (number + 0.5) / 1000) for number in range(1000)])


class Arrivals:
    """Frames that reach a node at random times, each at a random one of many streams, which hardly ever have two."""

    def __init__(self, times: Calibration, workers: int, load: float, mode: Mode, seconds: float) -> None:
        self.env = simpy.Environment()
        self.node = SimulatedNode(self.env, NodeShape(workers, processors=workers), times, Random(1))
        self.chance = Random(2)
        self.arrived: dict[tuple[int, int], float] = {}
        self.responses: list[float] = []
        self.in_system: list[int] = []
        self.seconds = seconds
        self.rate = load * workers / SERVICE_S
        self.streams = [self._stream(number, mode) for number in range(2000)]
        self.env.process(self._arrive())
        self.env.process(self._watch())
        self.env.run(seconds)

    def _stream(self, number: int, mode: Mode) -> SimulatedStream:
        def answer(seq: int, answered: bool) -> None:
            self.responses.append(self.env.now - self.arrived.pop((number, seq)))

        return SimulatedStream(self.node, mode, "cameras", answer)

    def _arrive(self) -> Process:
        seq = 0
        while True:
            yield self.env.timeout(self.chance.expovariate(self.rate))
            number = self.chance.randrange(len(self.streams))
            self.arrived[number, seq] = self.env.now
            self.env.process(self.streams[number].receive(seq))
            seq += 1

    def _watch(self) -> Process:
        while True:
            yield self.env.timeout(self.chance.expovariate(self.rate))
            self.in_system.append(len(self.arrived))

    @property
    def mean_wait_s(self) -> float:
        return mean(self.responses) - SERVICE_S

    def load(self, workers: int) -> float:
        """The load that came: the number of random arrivals is random itself."""
        return len(self.responses) / self.seconds * SERVICE_S / workers


@pytest.mark.parametrize("load", [0.5, 0.7])
def test_a_worker_with_constant_service_is_an_m_d_1_queue(load: float) -> None:
    arrivals = Arrivals(CONSTANT, 1, load, "all", 8000 * SERVICE_S / load)
    load = arrivals.load(1)
    assert arrivals.mean_wait_s == pytest.approx(SERVICE_S * load / (2.0 * (1.0 - load)), rel=0.1)


@pytest.mark.parametrize(("workers", "load"), [(1, 0.6), (3, 0.75)])
def test_workers_with_exponential_service_are_an_m_m_c_queue(workers: int, load: float) -> None:
    arrivals = Arrivals(EXPONENTIAL, workers, load, "latest", 10000 * SERVICE_S / workers / load)
    load = arrivals.load(workers)
    assert arrivals.mean_wait_s == pytest.approx(erlang_c(workers, load) * SERVICE_S / (workers * (1 - load)), rel=0.1)


def erlang_c(servers: int, load: float) -> float:
    """The probability that a customer waits."""
    offered = servers * load
    waiting = offered**servers / math.factorial(servers) / (1.0 - load)
    return waiting / (sum(offered**k / math.factorial(k) for k in range(servers)) + waiting)


def test_littles_law_holds() -> None:
    arrivals = Arrivals(EXPONENTIAL, 2, 0.7, "all", 60.0)
    rate = len(arrivals.responses) / arrivals.seconds
    assert mean(arrivals.in_system) == pytest.approx(rate * mean(arrivals.responses), rel=0.05)


def test_workers_are_busy_for_as_long_as_frames_take() -> None:
    result = run(Load(8, 10.0), NodeShape(2, processors=2))
    assert result.workers == pytest.approx(8 * 10.0 * SERVICE_S / 2, rel=0.02)
    assert result.processor == pytest.approx(result.workers, rel=0.01)
    assert result.outcome.answered_per_s == pytest.approx(80.0, rel=0.02)


def run(load: Load, shape: NodeShape, times: Calibration = CONSTANT, seed: int = 1, nodes: int = 1) -> SimulationResult:
    return simulate(Scenario(nodes, load, shape, seconds=30.0), times, seed)


def test_the_seed_decides_everything() -> None:
    load, shape = Load(5, 10.0), NodeShape(1, processors=1)
    first = run(load, shape, EXPONENTIAL)
    assert run(load, shape, EXPONENTIAL) == first
    assert run(load, shape, EXPONENTIAL, seed=2) != first


def test_mode_latest_drops_what_is_too_much() -> None:
    result = run(Load(4, 25.0), NodeShape(1, processors=1))
    assert result.outcome.answered_per_s == pytest.approx(1.0 / SERVICE_S, rel=0.02)
    assert result.outcome.dropped_share == pytest.approx(0.5, abs=0.02)
    # Each stream has one frame that waits, so no frame waits for more than the streams before it.
    assert result.outcome.p99_ms < 1e3 * SERVICE_S * 6


def test_mode_all_answers_everything_as_fast_as_the_workers_can() -> None:
    result = run(Load(4, None, "all", in_flight=2), NodeShape(1, processors=1))
    assert result.outcome.dropped_share == 0.0
    assert result.outcome.answered_per_s == pytest.approx(1.0 / SERVICE_S, rel=0.01)
    # By Little's law: of each stream two frames are on their way, and one waits in the client.
    assert result.outcome.p50_ms == pytest.approx(1e3 * SERVICE_S * 4 * 3, rel=0.05)


def test_a_session_is_saved_four_times_a_second_at_most() -> None:
    assert run(Load(4, 10.0), NodeShape(2)).saves_per_s == pytest.approx(16.0, rel=0.05)
    assert run(Load(4, 2.0), NodeShape(2)).saves_per_s == pytest.approx(8.0, rel=0.05)


def test_a_device_leaves_the_processors_free() -> None:
    times = calibration([0.002], wait_s=0.018)
    result = run(Load(8, 10.0), NodeShape(2, processors=1), times)
    assert result.workers == pytest.approx(0.8, rel=0.03)
    assert result.processor == pytest.approx(0.16, rel=0.03)


def test_the_streams_of_a_lost_node_go_on_elsewhere() -> None:
    scenario = Scenario(3, Load(24, 5.0), NodeShape(2), 10.0, lose_at=2.0)
    result = simulate(scenario, CONSTANT, 1)
    assert len(result.resumed_s) == 8
    assert max(result.resumed_s) < 1.0
    assert result.gave_up == 0
    # The lost node is tried first: it may be the only one that has the session.
    assert result.attempts == 16


def test_mode_all_loses_no_frame_with_its_node() -> None:
    scenario = Scenario(2, Load(4, 5.0, "all"), NodeShape(2), 10.0, lose_at=2.0)
    assert simulate(scenario, CONSTANT, 1).outcome.dropped_share == 0.0


def test_a_storm_lasts_as_long_as_the_other_node_needs_to_open_streams() -> None:
    times = replace(CONSTANT, open_s=0.05)
    scenario = Scenario(2, Load(40, 0.5), NodeShape(2), 20.0, "least", lose_at=2.0)
    result = simulate(scenario, times, 1)
    assert len(result.resumed_s) == 20
    assert max(result.resumed_s) > 20 * 0.05


def test_streams_give_up_if_no_node_takes_them_in_time() -> None:
    times = replace(CONSTANT, open_s=12.0)
    result = simulate(Scenario(2, Load(8, 2.0), NodeShape(2), 60.0, lose_at=2.0), times, 1)
    assert result.gave_up > 0


@pytest.mark.parametrize("balancer", ["rotated", "shuffled", "least"])
def test_balancers_that_count_give_each_node_as_many_streams(balancer: str) -> None:
    scenario = Scenario(3, Load(12, 5.0), NodeShape(1, processors=1), 20.0, balancer)  # type: ignore[arg-type]
    assert simulate(scenario, CONSTANT, 1).outcome.p99_ms < 1e3 * SERVICE_S * 5


def test_urls_in_the_same_order_give_all_streams_of_a_lost_node_to_the_next_one() -> None:
    scenario = Scenario(5, Load(20, 8.0), NodeShape(1, processors=1), 10.0, "rotated", lose_at=2.0)
    rotated, shuffled = (simulate(replace(scenario, balancer=each), CONSTANT, 1) for each in ("rotated", "shuffled"))
    assert rotated.outcome.dropped_share > 2.0 * shuffled.outcome.dropped_share


def test_a_random_balancer_overloads_some_nodes() -> None:
    counting = Scenario(5, Load(20, 10.0), NodeShape(1, processors=1), 5.0, "least")
    at_random = replace(counting, balancer="random")
    assert (
        simulate(at_random, CONSTANT, 1).outcome.dropped_share > simulate(counting, CONSTANT, 1).outcome.dropped_share
    )


def test_a_network_delays_both_ways() -> None:
    near = run(Load(1, 2.0), NodeShape(1))
    far = simulate(Scenario(1, Load(1, 2.0), NodeShape(1), 30.0, network=Network(0.05)), CONSTANT, 1)
    assert far.outcome.p50_ms - near.outcome.p50_ms == pytest.approx(100.0, abs=0.1)


class TestProcessor:
    @staticmethod
    def finish_times(processor: Processor, env: simpy.Environment, tasks: Sequence[float]) -> list[float]:
        ends = []

        def run_task(seconds: float) -> Process:
            yield processor.run(seconds)
            ends.append(env.now)

        for seconds in tasks:
            env.process(run_task(seconds))
        env.run()
        return ends

    def test_tasks_share_processors_that_do_not_suffice(self) -> None:
        env = simpy.Environment()
        assert self.finish_times(Processor(env, 1), env, [1.0, 2.0]) == pytest.approx([2.0, 3.0])

    def test_a_task_uses_one_processor(self) -> None:
        env = simpy.Environment()
        assert self.finish_times(Processor(env, 4), env, [1.0, 2.0]) == pytest.approx([1.0, 2.0])

    def test_a_limit_stops_tasks_until_the_next_period(self) -> None:
        env = simpy.Environment()
        processor = Processor(env, 2, limit=0.4)
        # 4 ms in each of two periods of 10 ms, and 1 ms of the third.
        assert self.finish_times(processor, env, [0.009]) == pytest.approx([0.021])
        assert processor.used_s == pytest.approx(0.009)

    def test_a_limit_holds_for_all_tasks_together(self) -> None:
        env = simpy.Environment()
        ends = self.finish_times(Processor(env, 2, limit=0.4), env, [0.02, 0.02, 0.02])
        assert ends[-1] == pytest.approx(0.06 / 0.4, abs=0.01)


def test_an_outcome_has_the_frames_of_its_time() -> None:
    frames = [FrameLife(0, 0.5, 0.6), FrameLife(0, 1.1, 1.3), FrameLife(0, 1.2, None), FrameLife(0, 1.9, 2.1)]
    result = outcome(frames, 1.0, 2.0)
    assert (result.answered_per_s, result.p50_ms) == (1.0, pytest.approx(200.0))
    assert result.dropped_share == pytest.approx(1 / 3)
    with pytest.raises(ValueError, match="no frame was answered"):
        outcome(frames, 5.0, 6.0)
