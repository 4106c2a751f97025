"""The service on a Ray cluster of several nodes on this machine. `make cluster-check` runs it with three nodes.

Its variables: CLUSTER_NODES and CLUSTER_STREAMS. It prints the times that it measured, and asserts none of them.
"""

from __future__ import annotations

import os
import statistics
import time
import warnings
from collections.abc import Iterator
from typing import Any

import fakes
import pytest
from pydantic import SecretStr
from raycluster import IN_FLIGHT, WAIT_S, Camera, RayCluster, ray_cluster
from redisserver import redis_server

from lanestream.cluster.ray_variables import RAY_VARIABLES
from lanestream.settings import Settings

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    serve = pytest.importorskip("ray.serve", reason="needs Ray: use `make cluster-check`")
    from lanestream.cluster.deployment import application
    from lanestream.cluster.options import ClusterOptions

pytestmark = pytest.mark.filterwarnings("ignore")

SECRET = "a secret that nobody may see anywhere"  # noqa: S105
NODES = int(os.environ.get("CLUSTER_NODES", "2"))
STREAMS = int(os.environ.get("CLUSTER_STREAMS", "8"))
# Serve counts streams every ten seconds, unless this is set.
QUICK = {"RAY_SERVE_HANDLE_AUTOSCALING_METRIC_PUSH_INTERVAL_S": "1"}


@pytest.fixture(scope="module")
def redis_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with redis_server(tmp_path_factory.mktemp("redis")) as url:
        yield url


@pytest.fixture(scope="module")
def cluster() -> Iterator[RayCluster]:
    with ray_cluster(NODES, **RAY_VARIABLES, **QUICK) as cluster:
        yield cluster


def deploy(redis_url: str, **options: Any) -> None:
    settings = Settings(redis_url=redis_url, processes=0, token_secret=SecretStr(SECRET))
    serve.run(application(settings, ClusterOptions(**options), fakes.engine), name="lanestream", route_prefix="/")


def open_cameras(urls: list[str], count: int = STREAMS, **camera: Any) -> list[Camera]:
    """Starts cameras, each of which tries another proxy first, and waits until all have answers."""
    starts = [number % len(urls) for number in range(count)]
    cameras = [Camera(number, [*urls[start:], *urls[:start]], **camera) for number, start in enumerate(starts)]
    for each in cameras:
        each.wait_for_answers(5)
    return cameras


def check(camera: Camera, lost: int) -> None:
    """Fails unless each frame has a result, in order, at most so many of them lost, over one session."""
    assert [result.frame.seq for result in camera.results] == list(range(camera.frames))
    assert {result.error.code for result in camera.results if result.error is not None} <= {"lost"}
    assert camera.lost <= lost
    assert len(camera.sessions) == 1
    late = [ids for _, _, ids in camera.answers[camera.first_frames :]]
    assert set(late) == {camera.ids}


def wait_for_replicas(cluster: RayCluster, count: int, *, each_with_sessions: bool = True) -> None:
    """Waits until so many replicas run, and no others stop or start."""
    end = time.monotonic() + WAIT_S
    while True:
        states = serve.status().applications["lanestream"].deployments["Lanestream"].replica_states
        found = {name: value for name, value in cluster.sessions().items() if value}
        if dict(states) == {"RUNNING": count} and (len(found) == count or not each_with_sessions):
            return
        assert time.monotonic() < end, (states, found)
        time.sleep(0.5)


def test_no_frame_is_lost_when_replicas_come_and_go(cluster: RayCluster, redis_url: str, capsys: Any) -> None:
    per_replica = STREAMS // NODES
    deploy(
        redis_url,
        max_replicas=NODES,
        sessions_per_replica=per_replica,
        upscale_delay_s=1.0,
        downscale_delay_s=1.0,
    )
    cameras = open_cameras(cluster.urls)
    wait_for_replicas(cluster, NODES)
    for camera in cameras[per_replica:]:
        camera.finish()
    wait_for_replicas(cluster, 1)
    for camera in cameras[:per_replica]:
        camera.finish()
    for camera in cameras:
        check(camera, lost=0)
        assert len(camera.answers) == camera.frames
    with capsys.disabled():
        print(
            f"\n{NODES} nodes, {STREAMS} streams, 1 to {NODES} to 1 replicas:"
            f" {sum(camera.frames for camera in cameras)} frames sent,"
            f" {sum(camera.frames - len(camera.answers) for camera in cameras)} without lanes,"
            f" {sum(camera.answers[-1][1] for camera in cameras)} reconnections"
        )


def test_a_restart_of_serves_controller_interrupts_no_stream(cluster: RayCluster, redis_url: str) -> None:
    deploy(redis_url, min_replicas=NODES, max_replicas=NODES)
    cameras = open_cameras(cluster.urls, NODES)
    cluster.kill("ray::ServeController")
    # Serve has found its replicas again, or replaced them, when its status says so.
    wait_for_replicas(cluster, NODES, each_with_sessions=False)
    for camera in cameras:
        camera.wait_for_answers(len(camera.answers) + 10)
        camera.finish()
        check(camera, lost=0)
        assert camera.answers[-1][1] == 0


def check_that_ray_shows_no_secret(cluster: RayCluster) -> None:
    """Fails if the dashboard, `serve status` or a log has the token secret."""
    import ray

    controller = ray.get_actor("SERVE_CONTROLLER_ACTOR", namespace="serve")
    shown = str(ray.get(controller.get_serve_instance_details.remote()))
    assert "health_check_timeout_s" in shown
    assert SECRET not in shown
    logs = [path for path in cluster.logs.rglob("*") if path.is_file()]
    assert any("replica" in path.name for path in logs)
    assert not [path for path in logs if SECRET.encode() in path.read_bytes()]


def test_streams_survive_the_loss_of_a_node(cluster: RayCluster, redis_url: str, capsys: Any) -> None:
    deploy(redis_url, min_replicas=NODES, max_replicas=NODES)
    cameras = open_cameras(cluster.urls)
    time.sleep(1.0)
    killed = time.monotonic()
    cluster.kill_last_node()
    for camera in cameras:
        count = len(camera.answers)
        camera.wait_for_answers(count + 10)
    time.sleep(3.0)
    for camera in cameras:
        camera.finish()
    check_that_ray_shows_no_secret(cluster)
    times = [seconds for camera in cameras if (seconds := camera.resumed_after(killed)) is not None]
    assert times, "no stream was on the node that was killed"
    for camera in cameras:
        check(camera, lost=IN_FLIGHT)
    with capsys.disabled():
        print(
            f"\n{NODES} nodes, {STREAMS} streams, one node killed: {len(times)} streams resumed,"
            f" after {statistics.median(times):.2f} s (median), {max(times):.2f} s (longest);"
            f" {sum(camera.frames for camera in cameras)} frames sent, {sum(len(camera.answers) for camera in cameras)}"
            f" answered, {sum(camera.lost for camera in cameras)} reported as lost"
        )
