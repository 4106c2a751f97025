"""Runs simulated cameras against simulated nodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from random import Random
from typing import Final, Literal, get_args

import numpy as np
import simpy

from capacity.calibration import Calibration
from capacity.load import FrameLife, Load, Outcome, outcome
from capacity.simulated_camera import Network, SimulatedCamera
from capacity.simulated_node import NodeShape, SimulatedNode

# How a camera gets its node. With `rotated` and `shuffled`, from its own list of URLs: the cameras have different ones
# first, and the others follow in the same order, or in a random one. With `least` and `random`, from a balancer behind
# one URL, which takes the node with the fewest streams, or any.
Balancer = Literal["rotated", "shuffled", "least", "random"]
BALANCERS: Final[tuple[Balancer, ...]] = get_args(Balancer)

# Left out at the beginning: the first frames come from the cameras in a row.
WARM_UP_S: Final = 4.0
# Frames that were captured before the end are still answered.
_DRAIN_S: Final = 5.0


@dataclass(frozen=True)
class Scenario:
    """What is simulated: `nodes`, and a `load`, whose cameras are those of all nodes together, for `seconds`.

    `lose_at` is when the first node is lost, in seconds after the warm-up.
    """

    nodes: int
    load: Load
    shape: NodeShape = NodeShape()
    seconds: float = 60.0
    balancer: Balancer = "rotated"
    network: Network | None = None
    lose_at: float | None = None


@dataclass(frozen=True)
class SimulationResult:
    """The outcome of a scenario.

    `queue_p95_ms` is the wait from a frame's arrival to its beginning. `processor` and `workers` are the shares of the
    time in which they worked, over all nodes. `resumed_s` has the seconds without answers for each camera of a lost
    node, and `gave_up` the number of those that found no other. `attempts` are the connections that they tried.
    """

    outcome: Outcome
    queue_p50_ms: float
    queue_p95_ms: float
    processor: float
    workers: float
    saves_per_s: float
    resumed_s: tuple[float, ...]
    gave_up: int
    attempts: int


def simulate(scenario: Scenario, calibration: Calibration, seed: int) -> SimulationResult:
    """Returns the result of a scenario. The same seed has the same result.

    Without a network of its own, the scenario has the one of the calibration. Raises ValueError if it answers no frame.
    """
    chance = Random(seed)  # noqa: S311
    env = simpy.Environment()
    nodes = [SimulatedNode(env, scenario.shape, calibration, Random(chance.random())) for _ in range(scenario.nodes)]  # noqa: S311
    network = scenario.network or Network(calibration.network_s)
    frames: list[FrameLife] = []
    cameras = [
        SimulatedCamera(
            env,
            number,
            scenario.load,
            _routes(scenario.balancer, nodes, number, chance),
            network,
            Random(chance.random()),  # noqa: S311
            frames,
        )
        for number in range(scenario.load.cameras)
    ]
    end = WARM_UP_S + scenario.seconds
    for camera in cameras:
        camera.start(end)
    if scenario.lose_at is not None:
        env.process(_lose(env, nodes[0], cameras, WARM_UP_S + scenario.lose_at))
    env.run(WARM_UP_S)
    processor_s, busy_s = sum(node.processor_s for node in nodes), sum(node.busy_s for node in nodes)
    saves = sum(node.saves for node in nodes)
    delays = [len(node.queue_delays) for node in nodes]
    env.run(end)
    processor_s = sum(node.processor_s for node in nodes) - processor_s
    busy_s = sum(node.busy_s for node in nodes) - busy_s
    saves = sum(node.saves for node in nodes) - saves
    waits = [1e3 * each for node, first in zip(nodes, delays, strict=True) for each in node.queue_delays[first:]]
    env.run(end + _DRAIN_S)
    shape = scenario.shape
    queue_p50, queue_p95 = (float(each) for each in np.percentile(waits or [0.0], (50, 95)))
    return SimulationResult(
        outcome(frames, WARM_UP_S, end),
        queue_p50,
        queue_p95,
        processor_s / (scenario.seconds * scenario.nodes * (shape.limit or shape.processors)),
        busy_s / (scenario.seconds * scenario.nodes * shape.workers),
        saves / scenario.seconds,
        tuple(each for camera in cameras for each in camera.resumed_s),
        sum(camera.gave_up for camera in cameras),
        sum(camera.attempts for camera in cameras),
    )


def _routes(
    balancer: Balancer, nodes: list[SimulatedNode], camera: int, chance: Random
) -> list[Callable[[], SimulatedNode]]:
    if balancer in ("rotated", "shuffled"):
        first = camera % len(nodes)
        others = nodes[first + 1 :] + nodes[:first]
        if balancer == "shuffled":
            chance.shuffle(others)
        return [partial(lambda node: node, node) for node in (nodes[first], *others)]

    def choose() -> SimulatedNode:
        alive = [node for node in nodes if not node.lost] or nodes
        return chance.choice(alive) if balancer == "random" else min(alive, key=lambda node: node.connections)

    return [choose]


def _lose(
    env: simpy.Environment, node: SimulatedNode, cameras: list[SimulatedCamera], at: float
) -> simpy.events.ProcessGenerator:
    yield env.timeout(at)
    node.lost = True
    for camera in cameras:
        if camera.node is node:
            camera.lose_connection()
