"""`make image-test`: builds the image, runs it as production should, and uses it as a client would.

Needs docker or podman. Prints one line a check; the exit code is 1 where one failed. What a machine needs beyond the
ordinary, such as a proxy or certificates of its own, goes to the engine by --build-option and --run-option.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import cv2
import httpx
import numpy as np
from demo import free_port
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from lanestream.errors import LanestreamError
from lanestream.protocol import SUBPROTOCOL
from lanestream_client import LaneClient
from lanestream_exporter.scenes import Drive, render_clip, sample_clip

NAME = "lanestream-image-check"
GUARDS = ("--read-only", "--tmpfs", "/tmp", "--cap-drop", "all", "--security-opt", "no-new-privileges")  # noqa: S108
READY_S, STOP_S, GRACE_S = 60.0, 15.0, 20
# Python runs by then, and the networks are not loaded yet.
EARLY_S = 1.0
SEED, FRAMES = 24, 50


class CheckError(Exception):
    """A check that failed, and how."""


@dataclass(frozen=True)
class Engine:
    """Docker or podman, by the name of its command."""

    command: str

    def run(self, *arguments: str) -> str:
        """What the command prints. Raises CheckError with the end of it where it fails."""
        done = subprocess.run([self.command, *arguments], capture_output=True, text=True, check=False)
        if done.returncode:
            raise CheckError(f"{self.command} {arguments[0]}: {(done.stderr or done.stdout)[-2000:].strip()}")
        return done.stdout

    def inspect(self, kind: str, name: str) -> dict[str, Any]:
        """What the engine knows of an image or a container."""
        found: dict[str, Any] = json.loads(self.run(kind, "inspect", name))[0]
        return found

    def size_mb(self, image: str) -> int:
        """Megabytes of an image with all its layers."""
        return int(self.inspect("image", image)["Size"]) // 1_000_000


@click.command()
@click.option("--engine", type=click.Choice(["docker", "podman"]), help="Default: docker, where it answers.")
@click.option("--target", type=click.Choice(["cpu", "gpu"]), default="cpu", show_default=True)
@click.option("--base-image", help="Default: the Dockerfile's.")
@click.option("--max-mb", type=int, help="What the image may add to its base  [default: 700 for cpu, no limit for gpu]")
@click.option("--build-option", "build_options", multiple=True, help="Passed to the engine's build; repeatable.")
@click.option("--run-option", "run_options", multiple=True, help="Passed to the engine's run; repeatable.")
def main(
    engine: str | None,
    target: str,
    base_image: str | None,
    max_mb: int | None,
    build_options: tuple[str, ...],
    run_options: tuple[str, ...],
) -> None:
    """Builds the image and checks it."""
    gpu = target == "gpu"
    limit = max_mb if max_mb is not None or gpu else 700
    try:
        chosen = Engine(engine or engine_here())
        base = base_image or default_base()
        image = build(chosen, target, base, build_options)
        check_size(chosen, image, base, limit)
        health = check_configuration(chosen, image)
        options = (*(("--gpus", "all") if gpu else ()), *run_options)
        check_early_stop(chosen, image, options)
        with running(chosen, image, options) as url:
            wait_until_ready(chosen, url)
            check_inside(chosen, health)
            pictures = road()
            check_answers(url, pictures)
            check_stop(chosen, url, pictures)
    except (CheckError, LanestreamError) as error:
        click.echo(f"FAIL  {error}")
        sys.exit(1)


def passed(what: str) -> None:
    """Says that a check passed."""
    click.echo(f"ok    {what}")


def engine_here() -> str:
    """The engine that answers on this machine. Raises CheckError where there is none."""
    for command in ("docker", "podman"):
        if shutil.which(command) and not subprocess.run([command, "info"], capture_output=True, check=False).returncode:
            return command
    raise CheckError("neither docker nor podman answers here")


def default_base() -> str:
    """The base that the Dockerfile names."""
    lines = Path("docker/Dockerfile").read_text(encoding="utf-8").splitlines()
    return next(line.partition("=")[2] for line in lines if line.startswith("ARG BASE_IMAGE="))


def build(engine: Engine, target: str, base: str, options: tuple[str, ...]) -> str:
    """The image, built."""
    image = f"lanestream:check-{target}"
    # Podman's own format has no place for a health check.
    form = ("--format", "docker") if engine.command == "podman" else ()
    where = ("-f", "docker/Dockerfile", "--target", target, "--build-arg", f"BASE_IMAGE={base}", "-t", image, ".")
    engine.run("build", *form, *options, *where)
    passed(f"build of target {target}")
    return image


def check_size(engine: Engine, image: str, base: str, limit: int | None) -> None:
    """An image that is small enough."""
    added = engine.size_mb(image) - engine.size_mb(base)
    if limit is not None and added > limit:
        raise CheckError(f"the image adds {added} MB to its base, more than {limit}")
    passed(f"adds {added} MB to its base" + (f" (limit {limit})" if limit is not None else ""))


def check_configuration(engine: Engine, image: str) -> list[str]:
    """An image that runs as a numbered user and knows when it is well; returns the command that tells."""
    about = engine.inspect("image", image)
    user = str(about["Config"].get("User", ""))
    number = user.partition(":")[0]
    if not number.isdecimal() or number == "0":
        raise CheckError(f"the image runs as user {user!r}, which is root or has no number")
    passed(f"runs as user {user}")
    health = about["Config"].get("Healthcheck") or about.get("HealthCheck") or about.get("Healthcheck")
    if not health or health["Test"][0] != "CMD":
        raise CheckError("the image has no health check")
    command: list[str] = health["Test"][1:]
    return command


@contextmanager
def running(engine: Engine, image: str, options: tuple[str, ...]) -> Iterator[str]:
    """A container of the image with every guard on, by its URL, before it is ready; removed afterwards."""
    port = str(free_port())
    publish = ("-p", f"127.0.0.1:{port}:{port}", "-e", f"LANESTREAM_PORT={port}")
    engine.run("run", "--detach", "--name", NAME, *GUARDS, *publish, *options, image)
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        engine.run("rm", "--force", NAME)


def wait_until_ready(engine: Engine, url: str) -> None:
    """Returns when the service answers that it is ready."""
    end = time.monotonic() + READY_S
    while time.monotonic() < end:
        try:
            if httpx.get(f"{url}/readyz").is_success:
                return passed("ready with a read-only root and no capabilities")
        except httpx.TransportError:
            pass
        time.sleep(0.2)
    log = subprocess.run([engine.command, "logs", NAME], capture_output=True, text=True, check=False)
    raise CheckError(f"not ready in {READY_S:.0f} s; its log ends\n{(log.stdout + log.stderr)[-2000:]}")


def check_early_stop(engine: Engine, image: str, options: tuple[str, ...]) -> None:
    """A container that ends when it is asked to while it still starts, though it is the first process in there."""
    with running(engine, image, options):
        time.sleep(EARLY_S)
        took, code = stop(engine)
    passed(f"SIGTERM while it starts: exit code {code} after {took:.1f} s")


def check_inside(engine: Engine, health: list[str]) -> None:
    """A container that is well by its own check, can't write, and has no more in it than it needs."""
    engine.run("exec", NAME, *health)
    passed("the health check passes")
    python = health[0]
    try:
        engine.run("exec", NAME, python, "-c", "open('/tmp/x', 'w'); open('/opt/x', 'w')")
    except CheckError as error:
        if "Read-only file system" not in str(error):
            raise
    else:
        raise CheckError("the root file system can be written")
    absent = "import importlib.util as u; print(*[m for m in ('torch', 'pip', 'setuptools') if u.find_spec(m)])"
    if found := engine.run("exec", NAME, python, "-c", absent).strip():
        raise CheckError(f"the image has {found} in it")
    passed("the root can't be written; no torch, no pip")


def road() -> list[bytes]:
    """A drive of two seconds, rendered, as JPEG files."""
    drive = Drive("highway", fair=True)
    clip = sample_clip(np.random.default_rng(SEED), 1280, 720, frames=FRAMES, fps=25.0, drive=drive)
    return [cv2.imencode(".jpg", frame.image)[1].tobytes() for frame in render_clip(clip)]


def check_answers(url: str, pictures: list[bytes]) -> None:
    """Lanes of a picture, and a stream of which every frame is answered."""
    with LaneClient(url) as client:
        found = client.detect(pictures[0]).lanes
        if len(found) < 2:
            raise CheckError(f"POST /v1/detect found {len(found)} boundaries on a rendered road")
        passed(f"POST /v1/detect: {len(found)} boundaries of a rendered road")
        answers = list(client.stream(pictures, mode="all"))
    missing = len(pictures) - sum(answer.lanes is not None for answer in answers)
    if missing:
        raise CheckError(f"{missing} of {len(pictures)} frames of a stream were not answered with lanes")
    passed(f"a stream: {len(answers)} frames, each answered")


def check_stop(engine: Engine, url: str, pictures: list[bytes]) -> None:
    """A container that is asked to end, tells its streams, answers what it has taken and ends, in good time."""
    with connect(
        f"{url.replace('http', 'ws', 1)}/v1/stream", subprotocols=[Subprotocol(SUBPROTOCOL)], compression=None
    ) as socket:
        socket.send('{"type": "start", "mode": "all"}')
        frames = pictures[: json.loads(socket.recv())["limits"]["credits"]]
        for picture in frames:
            socket.send(picture)
        told = [json.loads(socket.recv())["type"]]
        with ThreadPoolExecutor() as pool:
            stopping = pool.submit(stop, engine)
            told += [json.loads(message)["type"] for message in received(socket)]
            took, code = stopping.result()
    if told.count("lanes") != len(frames) or "draining" not in told:
        raise CheckError(f"SIGTERM with {len(frames)} frames under way: the stream was told {', '.join(told)}")
    passed(f"SIGTERM: the stream is told, its {len(frames)} frames are answered, exit code {code} after {took:.1f} s")


def stop(engine: Engine) -> tuple[float, int]:
    """Asks the container to end: the seconds that it took, and its exit code. Raises CheckError where it was killed."""
    start = time.monotonic()
    engine.run("stop", "-t", str(GRACE_S), NAME)
    took = time.monotonic() - start
    code: int = engine.inspect("container", NAME)["State"]["ExitCode"]
    if code not in (0, 143) or took > STOP_S:
        raise CheckError(f"SIGTERM: exit code {code} after {took:.1f} s")
    return took, code


def received(socket: ClientConnection) -> Iterator[str | bytes]:
    """The messages of a stream until the service closes it."""
    with suppress(ConnectionClosed):
        while True:
            yield socket.recv()


if __name__ == "__main__":
    main()
