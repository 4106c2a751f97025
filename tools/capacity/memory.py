"""What a stream needs besides processor time: memory in its node and in Redis, and bytes on the network."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Final

import psutil
import redis
from bench.frames import FPS

from capacity.cameras import CameraProcess, CameraRequest
from capacity.load import Load
from capacity.nodes import Node, NodeSetup, running_nodes, running_redis
from lanestream_client import LaneClient, SourceFrame

# Streams, and their frames per second: few enough that the node is not busy.
_STREAMS: Final = 100
_FPS: Final = 0.25
_SECONDS: Final = 16.0
# The bytes of WebSocket headers for a frame, which are two messages, and for its answer.
_FRAME_HEADERS: Final = 14 + 8
_ANSWER_HEADERS: Final = 4


@dataclass(frozen=True)
class StreamNeeds:
    """What one stream needs.

    `node_kilobytes` is memory of the service's own process, `redis_kilobytes` that of Redis, and `files` are those that
    the service has open for it. `redis_connections` are those of the node, and `idle_megabytes` is its memory without
    streams, with `workers` workers. `frame_bytes` and `answer_bytes` are those of a frame and of its answer on a
    WebSocket.
    """

    node_kilobytes: float
    redis_kilobytes: float
    files: float
    redis_connections: int
    idle_megabytes: float
    workers: int
    frame_bytes: float
    answer_bytes: float


def measure_stream_needs(frames: Path, folder: Path, workers: int = 2) -> StreamNeeds:
    """Measures a node with the JPEG files in `frames`."""
    images = [path.read_bytes() for path in sorted(frames.glob("*.jpg"))]
    with running_redis(folder) as url, running_nodes(1, NodeSetup(workers), url, folder) as nodes:
        answer = _answer_bytes(nodes[0].url, images)
        # What it allocates once, it has now.
        service = psutil.Process(nodes[0].pid)
        memory, files, stored = service.memory_full_info().uss, service.num_fds(), _redis_bytes(url)
        load = Load(_STREAMS, _FPS, "latest", 1)
        cameras = CameraProcess(CameraRequest(load, [[nodes[0].url]] * _STREAMS, _SECONDS, 0, frames))
        try:
            time.sleep(_SECONDS)
            grown = service.memory_full_info().uss - memory
            opened, kept = service.num_fds() - files, _redis_bytes(url) - stored
            connections = _redis_connections(url)
        finally:
            cameras.kill()
        idle = _tree_bytes(nodes[0])
    return StreamNeeds(
        1e-3 * grown / _STREAMS,
        1e-3 * kept / _STREAMS,
        opened / _STREAMS,
        connections,
        1e-6 * idle,
        workers,
        mean(len(image) for image in images) + len('{"type":"frame","seq":1000,"timestamp":1000.123}') + _FRAME_HEADERS,
        answer + _ANSWER_HEADERS,
    )


def _answer_bytes(url: str, images: list[bytes]) -> float:
    """Returns the mean size of the answers to frames, without the first ones, which have no confirmed lanes yet."""
    with LaneClient(url) as client:
        frames = (SourceFrame(seq, seq / FPS, image) for seq, image in enumerate(images))
        sizes = [len(each.lanes.model_dump_json()) for each in client.stream(frames, mode="all") if each.lanes]
    return mean(sizes[len(sizes) // 2 :])


def _redis_bytes(url: str) -> int:
    with redis.Redis.from_url(url) as client:
        return int(client.info("memory")["used_memory"])


def _redis_connections(url: str) -> int:
    """Returns the connections to Redis besides the one that asks."""
    with redis.Redis.from_url(url) as client:
        return int(client.info("clients")["connected_clients"]) - 1


def _tree_bytes(node: Node) -> int:
    root = psutil.Process(node.pid)
    return sum(each.memory_full_info().pss for each in (root, *root.children(recursive=True)))
