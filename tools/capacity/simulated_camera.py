"""A simulated camera with its client, which reconnects by the client's own `FailoverPolicy`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random
from typing import Final, cast

import simpy

from capacity.load import JITTER, FrameLife, Load
from capacity.simulated_node import Process, SimulatedNode, SimulatedStream
from lanestream.errors import ConnectionFailedError
from lanestream_client.endpoint import READY_TIMEOUT_S, Endpoint
from lanestream_client.failover import FailoverPolicy, RetryPolicy

_TIMEOUT_S: Final = 30.0


@dataclass(frozen=True)
class Network:
    """The way of a message in one direction: `delay_s`, and a random further delay with the mean `jitter_s`.

    The loss of a node reaches its clients after `detection_s` more: nothing if its processes end and its system closes
    their sockets, and the time until a ping fails if the machine is gone.
    """

    delay_s: float
    jitter_s: float = 0.0
    detection_s: float = 0.0


class SimulatedCamera:
    """One camera. `routes` are what it can connect to: each returns a node.

    With several, they are the URLs of the nodes; with one, that of a balancer. `frames` gets the lives of its frames.
    `caller` is whose key it uses.
    """

    def __init__(
        self,
        env: simpy.Environment,
        number: int,
        load: Load,
        routes: Sequence[Callable[[], SimulatedNode]],
        network: Network,
        chance: Random,
        frames: list[FrameLife],
        caller: str = "cameras",
    ) -> None:
        self._env, self._number, self._load, self._network, self._chance = env, number, load, network, chance
        self._frames, self._caller = frames, caller
        # The policy only chooses among them.
        endpoints = cast("Sequence[Endpoint]", routes)
        self._failover = FailoverPolicy(
            endpoints, RetryPolicy(), _TIMEOUT_S, clock=lambda: env.now, jitter=chance.random
        )
        self._unanswered: dict[int, int] = {}
        self._stream: SimulatedStream | None = None
        self._changed = env.event()
        self._last_arrival = self._last_return = 0.0
        self.node: SimulatedNode | None = None
        # The seconds from the loss of a node to the next answer, and whether it gave up.
        self.resumed_s: list[float] = []
        self._lost_at: float | None = None
        self.gave_up = False
        self.attempts = 0

    def start(self, until: float) -> None:
        """Connects, and sends frames until the time `until`."""
        self._attach(self._connect())
        self._failover.connected()
        self._env.process(self._send_frames(until))

    def lose_connection(self) -> None:
        """Loses the connection now, and reconnects."""
        self._lost_at = self._env.now
        self._env.process(self._reconnect())

    def _connect(self) -> SimulatedNode:
        """Connects to the node that the policy, or the balancer, chooses."""
        node = self.node = cast("Callable[[], SimulatedNode]", self._failover.endpoint)()
        node.connections += 1
        return node

    def _disconnect(self) -> None:
        assert self.node is not None  # noqa: S101 - it was connected
        self.node.connections -= 1
        self.node = None

    def _attach(self, node: SimulatedNode) -> None:
        def answer(seq: int, answered: bool) -> None:
            self._env.process(self._return(stream, seq, answered))

        stream = self._stream = SimulatedStream(node, self._load.mode, self._caller, answer)
        self._notify()

    def _notify(self) -> None:
        changed, self._changed = self._changed, self._env.event()
        changed.succeed()

    def _delay_s(self) -> float:
        jitter_s = self._network.jitter_s
        return self._network.delay_s + (self._chance.expovariate(1.0 / jitter_s) if jitter_s else 0.0)

    def _send_frames(self, until: float) -> Process:
        load, env = self._load, self._env
        first, number, seq = env.now + load.phase_s(self._number), 0, 0
        while True:
            if load.fps is not None:
                # A camera does not wait: what could not be sent in time was never captured.
                number = max(number, int((env.now - first) * load.fps))
                due = first + (number + JITTER * (2.0 * self._chance.random() - 1.0)) / load.fps
                yield env.timeout(max(0.0, due - env.now))
                number += 1
            if env.now >= until:
                return
            index = len(self._frames)
            self._frames.append(FrameLife(self._number, env.now, None))
            while self._stream is None or len(self._unanswered) >= load.in_flight:
                if self.gave_up:
                    return
                yield self._changed
            self._unanswered[seq] = index
            self._send(seq)
            seq += 1

    def _send(self, seq: int) -> None:
        assert self._stream is not None  # noqa: S101 - the caller waited for it
        # Messages of one connection arrive in order.
        self._last_arrival = max(self._last_arrival, self._env.now + self._delay_s())
        self._env.process(self._arrive(self._stream, seq, self._last_arrival - self._env.now))

    def _arrive(self, stream: SimulatedStream, seq: int, delay_s: float) -> Process:
        yield self._env.timeout(delay_s)
        if not stream.closed:
            yield from stream.receive(seq)

    def _return(self, stream: SimulatedStream, seq: int, answered: bool) -> Process:
        self._last_return = max(self._last_return, self._env.now + self._delay_s())
        yield self._env.timeout(self._last_return - self._env.now)
        if stream is not self._stream:
            return
        self._failover.progressed()
        if self._lost_at is not None:
            self.resumed_s.append(self._env.now - self._lost_at)
            self._lost_at = None
        # The node answers in order, so earlier frames without an answer were dropped.
        for each in [number for number in self._unanswered if number <= seq]:
            index = self._unanswered.pop(each)
            if each == seq and answered:
                life = self._frames[index]
                self._frames[index] = FrameLife(life.camera, life.captured, self._env.now)
        self._notify()

    def _reconnect(self) -> Process:
        """Loses the socket, and tries until a node has taken the stream over, or too much time has passed."""
        yield self._env.timeout(self._delay_s() + self._network.detection_s)
        assert self._stream is not None  # noqa: S101 - it was connected
        self._stream.close()
        self._stream = None
        self._disconnect()
        if self._load.mode == "latest":
            self._unanswered.clear()
        node: SimulatedNode | None = None
        while node is None:
            pause = self._failover.pause_after(ConnectionFailedError("the connection broke"))
            if pause is None:
                self.gave_up = True
                self._notify()
                return
            yield self._env.timeout(pause)
            self.attempts += 1
            node = yield from self._attempt()
        self._failover.connected()
        self._attach(node)
        for seq in self._unanswered:
            self._send(seq)

    def _attempt(self) -> simpy.events.ProcessGenerator:
        """Tries to open the stream. Returns the node that took it, or None."""
        node = self._connect()
        # TCP's handshake, and the request, or the refusal.
        yield self._env.timeout(2.0 * self._delay_s())
        if node.lost:
            return self._disconnect()
        yield self._env.timeout(self._delay_s())
        opening = self._env.process(node.open_stream())
        yield opening | self._env.timeout(max(self._failover.timeout_s, READY_TIMEOUT_S))
        if not opening.triggered or node.lost:
            return self._disconnect()
        yield self._env.timeout(self._delay_s())
        return node
