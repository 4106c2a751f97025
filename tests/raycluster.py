"""A cluster of several Ray nodes on this machine, each with a proxy on its own port, and cameras that stream to it."""

from __future__ import annotations

import os
import re
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import fakes
import httpx
import psutil

from lanestream_client import LaneClient, SourceFrame, StreamResult

# Far longer than anything takes, on a machine that does something else, too.
WAIT_S = 90.0
_TESTS = Path(__file__).parent
_NODE = {"num_cpus": 1, "object_store_memory": 100 << 20}
IN_FLIGHT = 2
# The frames between two pauses of a camera.
_FRAMES_BETWEEN = 4


class RayCluster:
    """Ray nodes with one processor each; the first one has Ray's head and Serve's controller."""

    def __init__(self, cluster: Any, ports: list[int]) -> None:
        self._cluster = cluster
        self.address: str = cluster.address
        self.logs = Path(cluster.head_node.get_logs_dir_path())
        self.ports = ports
        self.urls = [f"http://127.0.0.1:{port}" for port in ports]

    def kill_last_node(self) -> str:
        """Kills all processes of a node that is not the head, as a crash of its machine does. Returns its URL."""
        node = min(self._cluster.worker_nodes, key=lambda each: each.node_id)
        raylet = psutil.Process(node.all_processes["raylet"][0].process.pid)
        port = next(port for known, port in self._ports_by_node if known is node)
        processes = [*raylet.children(recursive=True), raylet]
        for process in processes:
            with suppress(psutil.NoSuchProcess):
                process.send_signal(signal.SIGKILL)
        psutil.wait_procs(processes, timeout=fakes.WAIT_S)
        return f"http://127.0.0.1:{port}"

    def kill(self, name: str) -> None:
        """Kills the processes of this cluster whose names begin with `name`."""
        nodes = [self._cluster.head_node, *self._cluster.worker_nodes]
        raylets = [psutil.Process(node.all_processes["raylet"][0].process.pid) for node in nodes]
        found = [
            process
            for raylet in raylets
            for process in raylet.children(recursive=True)
            if process.is_running() and process.status() != psutil.STATUS_ZOMBIE
            if " ".join(process.cmdline()).startswith(name)
        ]
        assert found, name
        for process in found:
            process.kill()

    def sessions(self) -> dict[str, float]:
        """Returns the open sessions of each replica, by its name, as Ray's metrics have them."""
        import ray

        found = {}
        for node in ray.nodes():
            if node["Alive"]:
                text = httpx.get(f"http://127.0.0.1:{node['MetricsExportPort']}/metrics", timeout=fakes.WAIT_S).text
                for labels, value in re.findall(r"^ray_lane_sessions_active{(.*)} (\S+)$", text, re.MULTILINE):
                    found[re.findall(r'replica="([^"]*)"', labels)[0]] = float(value)
        return found

    _ports_by_node: list[tuple[Any, int]]


@contextmanager
def ray_cluster(nodes: int, **variables: str) -> Iterator[RayCluster]:
    """Runs a cluster with environment variables, to which this process is connected, and Serve's proxies."""
    import ray
    from ray import cluster_utils, serve

    ports = free_ports(nodes)
    paths = os.pathsep.join([str(_TESTS), os.environ.get("PYTHONPATH", "")])
    with environment(PYTHONPATH=paths, **variables):
        cluster = cluster_utils.Cluster(initialize_head=True, head_node_args={**_NODE, "include_dashboard": False})
        try:
            running = RayCluster(cluster, ports)
            running._ports_by_node = [
                (cluster.add_node(**_NODE, env_vars={"RAY_SERVE_WORKER_PROXY_HTTP_PORT": str(port)}), port)
                for port in ports[1:]
            ]
            ray.init(cluster.address, log_to_driver=False)
            serve.start(proxy_location="EveryNode", http_options={"host": "127.0.0.1", "port": ports[0]})
            yield running
        finally:
            ray.shutdown()
            cluster.shutdown()


@contextmanager
def environment(**variables: str) -> Iterator[None]:
    """Sets environment variables during the block."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def free_ports(count: int) -> list[int]:
    """Returns ports on which nothing listens."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports: list[int] = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


@dataclass
class Camera:
    """A camera that streams in mode `all` until `stop` is set, in a thread.

    `number` decides the ids of its boundaries, so that a new session would have others: they are new after each pause.
    `answers` holds when each result came and how often the stream had reconnected by then.
    """

    number: int
    urls: list[str]
    image: bytes = field(default_factory=fakes.image_file)
    period_s: float = 0.2
    stop: threading.Event = field(default_factory=threading.Event)
    results: list[StreamResult] = field(default_factory=list)
    answers: list[tuple[float, int, frozenset[int]]] = field(default_factory=list)
    sessions: set[str] = field(default_factory=set)
    frames: int = 0
    lost: int = 0
    error: BaseException | None = None

    def __post_init__(self) -> None:
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def pauses(self) -> int:
        return self.number % 4 + 1

    @property
    def first_frames(self) -> int:
        """The number of frames before its boundaries have these ids."""
        return _FRAMES_BETWEEN * self.pauses

    @property
    def ids(self) -> frozenset[int]:
        """The ids of its two boundaries after all its pauses."""
        return frozenset({2 * self.pauses + 1, 2 * self.pauses + 2})

    def wait_for_answers(self, count: int) -> None:
        """Waits until it has so many answers with its final ids."""
        self._wait(lambda: sum(ids == self.ids for _, _, ids in self.answers) >= count)

    def finish(self) -> None:
        """Ends the stream and waits for its last answers. Raises what it raised."""
        self.stop.set()
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive()
        if self.error is not None:
            raise self.error

    def resumed_after(self, moment: float) -> float | None:
        """Returns the seconds from `moment` to the first answer over a new connection; None if it kept its own."""
        before = [reconnects for at, reconnects, _ in self.answers if at <= moment]
        later = [at - moment for at, reconnects, _ in self.answers if at > moment and reconnects > before[-1]]
        return later[0] if later else None

    def _wait(self, condition: Any) -> None:
        end = time.monotonic() + WAIT_S
        while not condition():
            assert self._thread.is_alive(), self.error
            assert time.monotonic() < end, f"camera {self.number} has {len(self.answers)} answers"
            time.sleep(0.02)

    def _run(self) -> None:
        try:
            with LaneClient(self.urls, in_flight=IN_FLIGHT) as client:
                stream = client.stream(self._source(), mode="all")
                for result in stream:
                    self.results.append(result)
                    if result.lanes is not None:
                        ids = frozenset(lane.track_id for lane in result.lanes.lanes)
                        self.answers.append((time.monotonic(), stream.reconnects, ids))
                        assert stream.ready is not None
                        self.sessions.add(stream.ready.session)
                        assert stream.ready.resumed == (stream.reconnects > 0)
                assert stream.summary is not None
                self.lost = stream.summary.lost
                assert stream.summary.frames == self.frames
        except BaseException as error:
            self.error = error

    def _source(self) -> Iterator[SourceFrame]:
        while not self.stop.is_set():
            jumps = min(self.frames // _FRAMES_BETWEEN, self.pauses)
            yield SourceFrame(self.frames, 100.0 * jumps + 0.2 * self.frames, data=self.image)
            self.frames += 1
            self.stop.wait(self.period_s)
