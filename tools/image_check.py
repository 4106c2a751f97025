"""`make image-test`: builds the container image, runs it as in production, and uses it as a client would.

Needs docker or podman. Prints one line per check; the exit code is 1 if one failed. Special options for the engine,
such as for a proxy or extra certificates, are passed with --build-option and --run-option.
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
HARDENING = ("--read-only", "--tmpfs", "/tmp", "--cap-drop", "all", "--security-opt", "no-new-privileges")  # noqa: S108
READY_S, STOP_S, GRACE_S = 60.0, 15.0, 20
# By then Python runs, but the networks are not loaded yet.
EARLY_STOP_S = 1.0
SEED, FRAMES = 24, 50


class CheckError(Exception):
    """A failed check."""


@dataclass(frozen=True)
class Engine:
    """A container engine: docker or podman."""

    command: str

    def run(self, *arguments: str) -> str:
        """Runs a command and returns its output. Raises CheckError with the end of the output if it fails."""
        result = subprocess.run([self.command, *arguments], capture_output=True, text=True, check=False)
        if result.returncode:
            raise CheckError(f"{self.command} {arguments[0]}: {(result.stderr or result.stdout)[-2000:].strip()}")
        return result.stdout

    def inspect(self, kind: str, name: str) -> dict[str, Any]:
        """Returns the engine's description of an image or a container."""
        found: dict[str, Any] = json.loads(self.run(kind, "inspect", name))[0]
        return found

    def size_mb(self, image: str) -> int:
        """Returns the size of an image with all its layers in MB."""
        return int(self.inspect("image", image)["Size"]) // 1_000_000


@click.command()
@click.option("--engine", type=click.Choice(["docker", "podman"]), help="Default: docker if it runs, else podman.")
@click.option("--target", type=click.Choice(["cpu", "gpu"]), default="cpu", show_default=True)
@click.option("--base-image", help="Default: the Dockerfile's.")
@click.option("--max-mb", type=int, help="Limit for what the image adds  [default: 700 for cpu, none for gpu]")
@click.option("--build-option", "build_options", multiple=True, help="An option for the engine's `build`; repeatable.")
@click.option("--run-option", "run_options", multiple=True, help="An option for the engine's `run`; repeatable.")
def main(
    engine: str | None,
    target: str,
    base_image: str | None,
    max_mb: int | None,
    build_options: tuple[str, ...],
    run_options: tuple[str, ...],
) -> None:
    """Build the image and check it."""
    gpu = target == "gpu"
    limit = max_mb if max_mb is not None or gpu else 700
    try:
        chosen = Engine(engine or find_engine())
        base = base_image or default_base()
        image = build(chosen, target, base, build_options)
        check_size(chosen, image, base, limit)
        health = check_configuration(chosen, image)
        options = (*(("--gpus", "all") if gpu else ()), *run_options)
        check_early_stop(chosen, image, options)
        with running(chosen, image, options) as url:
            wait_until_ready(chosen, url)
            check_inside(chosen, health)
            images = render_road()
            check_detection(url, images)
            check_stop(chosen, url, images)
    except (CheckError, LanestreamError) as error:
        click.echo(f"FAIL  {error}")
        sys.exit(1)


def passed(check: str) -> None:
    """Prints that a check passed."""
    click.echo(f"ok    {check}")


def find_engine() -> str:
    """Returns the engine that runs on this machine. Raises CheckError if there is none."""
    for command in ("docker", "podman"):
        if shutil.which(command) and not subprocess.run([command, "info"], capture_output=True, check=False).returncode:
            return command
    raise CheckError("neither docker nor podman runs on this machine")


def default_base() -> str:
    """Returns the default base image in the Dockerfile."""
    lines = Path("docker/Dockerfile").read_text(encoding="utf-8").splitlines()
    return next(line.partition("=")[2] for line in lines if line.startswith("ARG BASE_IMAGE="))


def build(engine: Engine, target: str, base: str, options: tuple[str, ...]) -> str:
    """Builds the image and returns its name."""
    image = f"lanestream:check-{target}"
    # Podman's own image format can't store a health check.
    image_format = ("--format", "docker") if engine.command == "podman" else ()
    arguments = ("-f", "docker/Dockerfile", "--target", target, "--build-arg", f"BASE_IMAGE={base}", "-t", image, ".")
    engine.run("build", *image_format, *options, *arguments)
    passed(f"build of target {target}")
    return image


def check_size(engine: Engine, image: str, base: str, limit: int | None) -> None:
    """Checks that the image is small enough."""
    added = engine.size_mb(image) - engine.size_mb(base)
    if limit is not None and added > limit:
        raise CheckError(f"the image adds {added} MB to its base, more than the limit of {limit} MB")
    passed(f"adds {added} MB to its base" + (f" (limit {limit})" if limit is not None else ""))


def check_configuration(engine: Engine, image: str) -> list[str]:
    """Checks that the image runs as a numbered user, and returns the command of its health check."""
    description = engine.inspect("image", image)
    user = str(description["Config"].get("User", ""))
    number = user.partition(":")[0]
    if not number.isdecimal() or number == "0":
        raise CheckError(f"the image runs as user {user!r}, which is root or has no number")
    passed(f"runs as user {user}")
    health = (
        description["Config"].get("Healthcheck") or description.get("HealthCheck") or description.get("Healthcheck")
    )
    if not health or health["Test"][0] != "CMD":
        raise CheckError("the image has no health check")
    command: list[str] = health["Test"][1:]
    return command


@contextmanager
def running(engine: Engine, image: str, options: tuple[str, ...]) -> Iterator[str]:
    """Starts a hardened container, yields its URL before it is ready, and removes it afterwards."""
    port = str(free_port())
    publish = ("-p", f"127.0.0.1:{port}:{port}", "-e", f"LANESTREAM_PORT={port}")
    engine.run("run", "--detach", "--name", NAME, *HARDENING, *publish, *options, image)
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        engine.run("rm", "--force", NAME)


def wait_until_ready(engine: Engine, url: str) -> None:
    """Returns when the service is ready. Raises CheckError if it does not get ready."""
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
    """Checks that SIGTERM ends a container that is still starting, although the service is its process 1."""
    with running(engine, image, options):
        time.sleep(EARLY_STOP_S)
        took, code = stop(engine)
    passed(f"SIGTERM during the start: exit code {code} after {took:.1f} s")


def check_inside(engine: Engine, health: list[str]) -> None:
    """Checks that a container is healthy, has a read-only root, and contains no torch and no pip."""
    engine.run("exec", NAME, *health)
    passed("the health check passes")
    python = health[0]
    try:
        engine.run("exec", NAME, python, "-c", "open('/tmp/x', 'w'); open('/opt/x', 'w')")
    except CheckError as error:
        if "Read-only file system" not in str(error):
            raise
    else:
        raise CheckError("the root file system is writable")
    absent = "import importlib.util as u; print(*[m for m in ('torch', 'pip', 'setuptools') if u.find_spec(m)])"
    if found := engine.run("exec", NAME, python, "-c", absent).strip():
        raise CheckError(f"the image contains {found}")
    passed("the root is read-only; no torch, no pip")


def render_road() -> list[bytes]:
    """Returns a rendered drive of two seconds as JPEG files."""
    drive = Drive("highway", fair=True)
    clip = sample_clip(np.random.default_rng(SEED), 1280, 720, frames=FRAMES, fps=25.0, drive=drive)
    return [cv2.imencode(".jpg", frame.image)[1].tobytes() for frame in render_clip(clip)]


def check_detection(url: str, images: list[bytes]) -> None:
    """Checks that lanes are found in one image, and in every frame of a stream."""
    with LaneClient(url) as client:
        found = client.detect(images[0]).lanes
        if len(found) < 2:
            raise CheckError(f"POST /v1/detect found {len(found)} boundaries on a rendered road")
        passed(f"POST /v1/detect: {len(found)} boundaries of a rendered road")
        answers = list(client.stream(images, mode="all"))
    missing = len(images) - sum(answer.lanes is not None for answer in answers)
    if missing:
        raise CheckError(f"{missing} of {len(images)} frames of a stream were not answered with lanes")
    passed(f"a stream: {len(answers)} frames, each answered")


def check_stop(engine: Engine, url: str, images: list[bytes]) -> None:
    """Checks that after SIGTERM a container notifies its streams, answers all accepted frames and ends in time."""
    with connect(
        f"{url.replace('http', 'ws', 1)}/v1/stream", subprotocols=[Subprotocol(SUBPROTOCOL)], compression=None
    ) as socket:
        socket.send('{"type": "start", "mode": "all"}')
        frames = images[: json.loads(socket.recv())["limits"]["credits"]]
        for image in frames:
            socket.send(image)
        types = [json.loads(socket.recv())["type"]]
        with ThreadPoolExecutor() as pool:
            stopping = pool.submit(stop, engine)
            types += [json.loads(message)["type"] for message in messages_until_close(socket)]
            took, code = stopping.result()
    if types.count("lanes") != len(frames) or "draining" not in types:
        raise CheckError(f"SIGTERM with {len(frames)} frames in flight: the stream received {', '.join(types)}")
    passed(
        f"SIGTERM: the stream was notified, its {len(frames)} frames were answered, exit code {code} after {took:.1f} s"
    )


def stop(engine: Engine) -> tuple[float, int]:
    """Stops the container. Returns the seconds it took and the exit code. Raises CheckError if it was killed."""
    start = time.monotonic()
    engine.run("stop", "-t", str(GRACE_S), NAME)
    took = time.monotonic() - start
    code: int = engine.inspect("container", NAME)["State"]["ExitCode"]
    if code not in (0, 143) or took > STOP_S:
        raise CheckError(f"SIGTERM: exit code {code} after {took:.1f} s")
    return took, code


def messages_until_close(socket: ClientConnection) -> Iterator[str | bytes]:
    """Yields the messages of a stream until the service closes it."""
    with suppress(ConnectionClosed):
        while True:
            yield socket.recv()


if __name__ == "__main__":
    main()
