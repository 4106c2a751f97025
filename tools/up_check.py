"""`make up-check`: runs all of docker/compose.yaml with `make up`, and checks it from outside, as its operator would.

It needs docker with Compose, or podman with podman-compose. It works in a copy of the checkout, under a Compose project
of its own and on free ports, so it does not touch a stack that runs already. Where the images of Redis, Prometheus or
Grafana can't be pulled, it builds the stand-ins of tools/stand_ins. Prints one line per check; the exit code is 1 if
one failed.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import click
import httpx
import yaml
from demo import free_port
from image_check import CheckError, Engine, find_engine, passed, render_road
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from lanestream.errors import LanestreamError
from lanestream.protocol import SUBPROTOCOL
from lanestream_client import LaneClient

ROOT: Final = Path(__file__).parents[1]
STAND_INS: Final = ROOT / "tools/stand_ins"
PROJECT: Final = "lanestream-up-check"
SERVICES: Final = ("lanestream", "redis", "prometheus", "grafana")
WAIT_S: Final = 60.0
# The frames before a restart: enough for confirmed tracks. And the rate of the rendered frames.
FRAMES_BEFORE: Final = 10
FPS: Final = 25.0
# Podman raises these limits of its containers by default, which needs a capability. Any host allows these.
LIMITS: Final = {"nofile": 8192, "nproc": 4096}


@dataclass(frozen=True)
class Stack:
    """The copy of the checkout in `folder` and what `make` needs to run it."""

    engine: Engine
    folder: Path
    variables: tuple[str, ...]
    url: str
    dashboard: str

    def make(self, target: str) -> str:
        """Runs a target of the Makefile and returns its output. Raises CheckError with its end if it fails."""
        command = ["make", target, f"ENGINE={self.engine.command}", *self.variables]
        result = subprocess.run(
            command, cwd=self.folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
        )
        if result.returncode:
            raise CheckError(f"make {target} fails:\n{result.stdout[-3000:].strip()}")
        return result.stdout

    def container(self, service: str) -> dict[str, Any]:
        """Returns the engine's description of a service's only container."""
        filters = (f"label=com.docker.compose.project={PROJECT}", f"label=com.docker.compose.service={service}")
        names = self.engine.run("ps", "--all", "--quiet", *(f"--filter={each}" for each in filters)).split()
        if len(names) != 1:
            raise CheckError(f"service {service} has {len(names)} containers instead of 1")
        return self.engine.inspect("container", names[0])

    def run_in(self, service: str, *command: str) -> str:
        """Runs a command in a service's container and returns its output."""
        return self.engine.run("exec", self.container(service)["Id"], *command)

    @property
    def secrets(self) -> Path:
        """The folder of the generated secrets."""
        return self.folder / "docker/secrets"

    @property
    def key(self) -> str:
        """The key `local`."""
        return (self.secrets / "local_key").read_text().strip()


@click.command()
@click.option("--engine", type=click.Choice(["docker", "podman"]), help="Default: docker if it runs, else podman.")
@click.option("--base-image", help="Base of the service's image and of stand-ins.  [default: the Dockerfiles']")
@click.option("--build-options", default="", help="Options for the engine's `build`, in one argument.")
def main(engine: str | None, base_image: str | None, build_options: str) -> None:
    """Start everything as `make up` does, and check it."""
    try:
        chosen = Engine(engine or find_engine())
        with tempfile.TemporaryDirectory(prefix="lanestream-up-check-") as folder:
            configure_podman(chosen, Path(folder))
            checkout = copy_checkout(Path(folder, "lanestream"))
            prepare_compose_file(chosen, checkout / "docker/compose.yaml", base_image, build_options)
            with removed_at_end(make_stack(chosen, checkout, base_image, build_options)) as stack:
                check(stack)
    except (CheckError, LanestreamError, httpx.HTTPError) as error:
        click.echo(f"FAIL  {error}")
        sys.exit(1)


def check(stack: Stack) -> None:
    """Runs all checks."""
    check_addresses(stack, stack.make("up"))
    check_secrets(stack)
    check_containers(stack)
    check_ready(stack, store_reachable=True)
    check_access(stack)
    images = render_road()
    check_stream(stack, images)
    check_resume(stack, images)
    check_prometheus(stack)
    check_grafana(stack)
    check_lost_redis(stack, images)
    secrets = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in stack.secrets.iterdir()}
    check_down(stack)
    check_addresses(stack, stack.make("up"))
    if {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in stack.secrets.iterdir()} != secrets:
        raise CheckError("a second `make up` changed docker/secrets")
    passed("a second `make up` keeps the secrets")
    check_ready(stack, store_reachable=True)
    check_stream(stack, images)
    check_down(stack)


def configure_podman(engine: Engine, folder: Path) -> None:
    """Lets podman run without systemd and without the right to raise limits, as in a container or a sandbox."""
    if engine.command != "podman" or Path("/run/systemd/system").exists() or "CONTAINERS_CONF" in os.environ:
        return
    limits = json.dumps([f"{name}={limit}:{limit}" for name, limit in LIMITS.items()])
    configuration = folder / "containers.conf"
    configuration.write_text(
        f'[containers]\ndefault_ulimits = {limits}\n[engine]\ncgroup_manager = "cgroupfs"\nevents_logger = "file"\n'
        '[network]\nnetwork_backend = "netavark"\n'
    )
    os.environ["CONTAINERS_CONF"] = str(configuration)
    click.echo("note  no systemd: podman manages cgroups itself, and runs no health checks by itself")


def copy_checkout(folder: Path) -> Path:
    """Copies what git would commit, so that no file of this checkout is changed or in the way."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    for name in filter(None, names):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def prepare_compose_file(engine: Engine, file: Path, base_image: str | None, build_options: str) -> None:
    """Renames the project in the copied compose file, and replaces images that can't be pulled by stand-ins."""
    text = file.read_text().replace("name: lanestream\n", f"name: {PROJECT}\n", 1)
    for service in SERVICES[1:]:
        image = yaml.safe_load(text)["services"][service]["image"]
        if available(engine, image):
            passed(f"image of {service}: {image}")
        else:
            stand_in = build_stand_in(engine, service, base_image, build_options)
            text = text.replace(f"image: {image}\n", f"image: {stand_in}\n")
            click.echo(f"note  {image} can't be pulled: a stand-in takes its place")
    if engine.command == "podman" and not may_raise_limits():
        text = text.replace("    nofile: {", f"    nproc: {LIMITS['nproc']}\n    nofile: {{")
    file.write_text(text)


def available(engine: Engine, image: str) -> bool:
    """Returns whether the engine has an image or can pull it."""
    for action in (("image", "inspect"), ("pull", "--quiet")):
        if not subprocess.run([engine.command, *action, image], capture_output=True, check=False).returncode:
            return True
    return False


def may_raise_limits() -> bool:
    """Returns whether this process has the capability CAP_SYS_RESOURCE."""
    effective = re.search(r"^CapEff:\s*(\w+)$", Path("/proc/self/status").read_text(), flags=re.MULTILINE)
    return effective is not None and bool(int(effective[1], 16) >> 24 & 1)


def build_stand_in(engine: Engine, service: str, base_image: str | None, build_options: str) -> str:
    """Builds the stand-in of an image and returns its name."""
    image = f"localhost/lanestream-stand-in:{service}"
    base = ("--build-arg", f"BASE_IMAGE={base_image}") if base_image else ()
    engine.run("build", "--target", service, "-t", image, *base, *shlex.split(build_options), str(STAND_INS))
    return image


def make_stack(engine: Engine, folder: Path, base_image: str | None, build_options: str) -> Stack:
    """Returns the stack, not yet started, with free ports."""
    service, dashboard = (f"127.0.0.1:{free_port()}" for _ in range(2))
    variables = [f"LANESTREAM_PUBLISH={service}", f"GRAFANA_PUBLISH={dashboard}", f"COMPOSE_PROJECT_NAME={PROJECT}"]
    variables += [f"BASE_IMAGE={base_image}"] if base_image else []
    variables += [f"BUILD_OPTIONS={build_options}"] if build_options else []
    return Stack(engine, folder, tuple(variables), f"http://{service}", f"http://{dashboard}")


@contextmanager
def removed_at_end(stack: Stack) -> Iterator[Stack]:
    """Yields the stack and removes its containers, networks and volumes afterwards, whatever happened."""
    try:
        yield stack
    finally:
        command = ["docker/compose", stack.engine.command, "cpu", "down", "--volumes"]
        subprocess.run(
            command,
            cwd=stack.folder,
            capture_output=True,
            check=False,
            env={**os.environ, "COMPOSE_PROJECT_NAME": PROJECT},
        )


def check_addresses(stack: Stack, output: str) -> None:
    """Checks that `make up` printed where the service and the dashboard are."""
    for address in (stack.url, stack.dashboard):
        if f"{address}," not in output:
            raise CheckError(f"make up did not print {address}:\n{output[-1000:]}")
    passed("make up: starts everything and prints the ports that were set")


def check_secrets(stack: Stack) -> None:
    """Checks that only their owner can reach the secrets."""
    modes = {path.name: path.stat().st_mode & 0o777 for path in (stack.secrets, *stack.secrets.iterdir())}
    expected = {"secrets": 0o700, "local_key": 0o600}
    expected |= dict.fromkeys(("api_keys", "prometheus_key", "grafana_password"), 0o644)
    if modes != expected:
        raise CheckError(f"permissions in docker/secrets are {modes} instead of {expected}")
    passed("docker/secrets: only its owner can open the folder")


def check_containers(stack: Stack) -> None:
    """Checks each container: it runs, is hardened and healthy, and publishes what was set and nothing else."""
    published = {"lanestream": {"8000/tcp": stack.url}, "grafana": {"3000/tcp": stack.dashboard}}
    for service in SERVICES:
        container = stack.container(service)
        host = container["HostConfig"]
        ports = {
            port: [f"http://{each['HostIp']}:{each['HostPort']}" for each in bindings]
            for port, bindings in (container["NetworkSettings"]["Ports"] or {}).items()
            if bindings
        }
        if ports != {port: [address] for port, address in published.get(service, {}).items()}:
            raise CheckError(f"service {service} publishes {ports}")
        if not (container["State"]["Running"] and host["ReadonlyRootfs"] and not host["Privileged"] and host["Memory"]):
            raise CheckError(f"service {service} does not run, is writable, is privileged, or has no memory limit")
        capabilities = re.search(r"CapBnd:\s*(\w+)", stack.run_in(service, "cat", "/proc/1/status"))
        if capabilities is None or int(capabilities[1], 16):
            raise CheckError(f"service {service} has capabilities")
        wait_until(lambda container=container: healthy(stack.engine, container["Id"]), f"{service} is not healthy")
    passed(f"{len(SERVICES)} containers: healthy, read-only, without capabilities, no other port published")


def healthy(engine: Engine, container: str) -> bool:
    """Returns whether a container's health check passes. Podman runs it now: without systemd, nothing else does."""
    if engine.command == "podman":
        return not subprocess.run(
            [engine.command, "healthcheck", "run", container], capture_output=True, check=False
        ).returncode
    return bool(engine.inspect("container", container)["State"]["Health"]["Status"] == "healthy")


def check_ready(stack: Stack, *, store_reachable: bool) -> None:
    """Checks that the service is ready, and that it reports whether it can reach Redis."""

    def matches() -> bool:
        try:
            answer = httpx.get(f"{stack.url}/readyz")
        except httpx.TransportError:
            return False
        return answer.is_success and (answer.json()["store"], answer.json()["store_reachable"]) == (
            "redis",
            store_reachable,
        )

    wait_until(matches, f"/readyz does not become 200 with store_reachable {store_reachable}")
    passed(f"/readyz: 200, Redis {'can' if store_reachable else 'can not'} be reached")


def check_access(stack: Stack) -> None:
    """Checks that nobody gets in without a key, and that each key works."""
    prometheus = (stack.secrets / "prometheus_key").read_text().strip()
    for key, expected in ((None, 401), ("lane_wrong", 401), (prometheus, 200), (stack.key, 200)):
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        status = httpx.get(f"{stack.url}/metrics", headers=headers).status_code
        if status != expected:
            raise CheckError(f"/metrics answers {status} instead of {expected}")
    passed("/metrics: 401 without a key, 200 with each of the two keys")


def check_stream(stack: Stack, images: list[bytes]) -> None:
    """Checks that every frame of a stream is answered with lanes."""
    with LaneClient(stack.url, api_key=stack.key) as client:
        answers = list(client.stream(images, mode="all"))
    missing = len(images) - sum(answer.lanes is not None for answer in answers)
    if missing:
        raise CheckError(f"{missing} of {len(images)} frames of a stream were not answered with lanes")
    passed(f"a stream with the key `local`: {len(answers)} frames, each answered")


def check_resume(stack: Stack, images: list[bytes]) -> None:
    """Checks that a session survives a restart of the service, which has only Redis to remember it."""
    with stream(stack) as socket:
        token = start(socket)["resume_token"]
        before = [answer(socket, images, index) for index in range(FRAMES_BEFORE)][-1]
    stack.engine.run("restart", "-t", "30", stack.container("lanestream")["Id"])
    check_ready(stack, store_reachable=True)
    with stream(stack) as socket:
        if not start(socket, resume_token=token)["resumed"]:
            raise CheckError("a session was not resumed after a restart of the service")
        after = answer(socket, images, FRAMES_BEFORE)
    ids = [[lane["track_id"] for lane in each["lanes"]] for each in (before, after)]
    if not ids[0] or ids[0] != ids[1]:
        raise CheckError(f"the track ids before and after a restart of the service are {ids[0]} and {ids[1]}")
    passed(f"a restart of the service: the session was resumed from Redis with the same {len(ids[0])} tracks")


def stream(stack: Stack) -> ClientConnection:
    """Opens a stream with the key `local`."""
    return connect(
        f"{stack.url.replace('http', 'ws', 1)}/v1/stream",
        subprotocols=[Subprotocol(SUBPROTOCOL)],
        compression=None,
        additional_headers={"Authorization": f"Bearer {stack.key}"},
    )


def start(socket: ClientConnection, **fields: str) -> dict[str, Any]:
    """Sends `start` and returns `ready`."""
    socket.send(json.dumps({"type": "start", "mode": "all", **fields}))
    return received(socket, "ready")


def answer(socket: ClientConnection, images: list[bytes], index: int) -> dict[str, Any]:
    """Sends a frame with its capture time, so that a pause between frames does not count, and returns its answer."""
    socket.send(json.dumps({"type": "frame", "timestamp": index / FPS}))
    socket.send(images[index])
    return received(socket, "lanes")


def received(socket: ClientConnection, kind: str) -> dict[str, Any]:
    """Returns the next message. Raises CheckError if it is of another type."""
    message: dict[str, Any] = json.loads(socket.recv(timeout=WAIT_S))
    if message["type"] != kind:
        raise CheckError(f"the stream received {message} instead of {kind}")
    return message


def prometheus(stack: Stack, path: str) -> Any:
    """Returns the data of an answer of Prometheus' API, which is not published."""
    url = f"http://127.0.0.1:9090/api/v1/{path}"
    return json.loads(stack.run_in("prometheus", "wget", "-qO-", url))["data"]


def check_prometheus(stack: Stack) -> None:
    """Checks that Prometheus scrapes the service with its key, and has evaluated every alert."""

    def scraped() -> bool:
        targets = prometheus(stack, "targets?state=active")["activeTargets"]
        return [target["health"] for target in targets if target["labels"]["job"] == "lanestream"] == ["up"]

    wait_until(scraped, "Prometheus does not scrape the service")
    passed("Prometheus scrapes the service with its mounted key")

    alerts = yaml.safe_load((ROOT / "docker/prometheus/alerts.yaml").read_text())["groups"][0]["rules"]
    names = {alert["alert"] for alert in alerts}

    def evaluated() -> bool:
        rules = [rule for group in prometheus(stack, "rules")["groups"] for rule in group["rules"]]
        return {rule["name"] for rule in rules if rule["health"] == "ok"} == names

    wait_until(evaluated, "Prometheus could not evaluate every alert")
    passed(f"Prometheus evaluates all {len(names)} alerts")


def check_grafana(stack: Stack) -> None:
    """Checks Grafana's password, dashboard, and access to Prometheus' data."""
    password = (stack.secrets / "grafana_password").read_text().strip()
    with httpx.Client(base_url=stack.dashboard) as client:
        if client.get("/api/search?type=dash-db").status_code != 401:
            raise CheckError("Grafana can be used without a password")
        client.auth = httpx.BasicAuth("admin", password)
        dashboards = client.get("/api/search?type=dash-db").raise_for_status().json()
        if [each["title"] for each in dashboards] != ["Lanestream"]:
            raise CheckError(f"Grafana has the dashboards {dashboards}")
        query = "/api/datasources/proxy/uid/prometheus/api/v1/query?query=lane_frames_processed_total"
        wait_until(
            lambda: bool(client.get(query).raise_for_status().json()["data"]["result"]),
            "Grafana's data source has no frames of the service",
        )
    passed("Grafana: the generated password, the dashboard, and data from Prometheus")


def check_lost_redis(stack: Stack, images: list[bytes]) -> None:
    """Checks that streams live without Redis, and that the loss is reported."""

    def alert() -> bool:
        alerts = prometheus(stack, "alerts")["alerts"]
        return any(each["labels"]["alertname"] == "LanestreamStoreUnreachable" for each in alerts)

    redis = stack.container("redis")["Id"]
    stack.engine.run("stop", "-t", "5", redis)
    check_ready(stack, store_reachable=False)
    check_stream(stack, images)
    wait_until(alert, "the loss of Redis raises no alert")
    stack.engine.run("start", redis)
    check_ready(stack, store_reachable=True)
    wait_until(lambda: not alert(), "the alert does not end when Redis is back")
    passed("the loss of Redis raises an alert, which ends when Redis is back")


def check_down(stack: Stack) -> None:
    """Checks that `make down` removes all containers and networks, and keeps the recorded metrics."""
    stack.make("down")
    label = f"--filter=label=com.docker.compose.project={PROJECT}"
    containers = stack.engine.run("ps", "--all", "--quiet", label).split()
    networks = stack.engine.run("network", "ls", "--quiet", label).split()
    volumes = stack.engine.run("volume", "ls", "--quiet", label).split()
    if containers or networks or len(volumes) != 2:
        raise CheckError(f"make down leaves {len(containers)} containers, {len(networks)} networks, volumes {volumes}")
    passed("make down: removes all containers and networks, keeps the two volumes")


def wait_until(condition: Callable[[], bool], problem: str) -> None:
    """Returns when `condition` holds. Raises CheckError with `problem` if that takes longer than a minute."""
    end = time.monotonic() + WAIT_S
    while not condition():
        if time.monotonic() > end:
            raise CheckError(f"{problem} within {WAIT_S:.0f} s")
        time.sleep(0.5)


if __name__ == "__main__":
    main()
