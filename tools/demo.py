"""`make demo`: streams a video to a service that it starts, as a user would, and writes the results to out/.

Without a video it renders one. The service runs on a free port and is always stopped at the end. Other tools use the
functions that start and stop it.
"""

from __future__ import annotations

import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx

OUT = Path("out")
LANESTREAM = Path(sys.executable).with_name("lanestream")
READY_S = 60.0


def main(video: str | None) -> int:
    """Runs the demo and returns the exit code of the stream."""
    OUT.mkdir(exist_ok=True)
    if video is None:
        video = str(OUT / "scene.mp4")
        print(f"rendering {video}", flush=True)
        code = subprocess.run([LANESTREAM, "scene", video, "--kind", "lane_change"], check=False).returncode
        if code:
            return code
    name = Path(video).stem
    results, annotated = OUT / f"{name}.lanes.jsonl", OUT / f"{name}.annotated.mp4"
    with service(OUT / "service.log") as url:
        command = [LANESTREAM, "stream", video, "--url", url, "--mode", "all"]
        code = subprocess.run([*command, "--jsonl", results, "--video", annotated], check=False).returncode
    if code == 0:
        print(f"wrote      {annotated}\n           {results}")
    return code


@contextmanager
def service(log_path: Path, *arguments: str | Path) -> Iterator[str]:
    """Starts a service on a free port with further `arguments` and yields its URL; its log goes to `log_path`."""
    with service_process(log_path, *arguments) as (_, url):
        yield url


@contextmanager
def service_process(log_path: Path, *arguments: str | Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """Like `service`, but yields the process as well."""
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    with log_path.open("w") as log:
        process = subprocess.Popen([LANESTREAM, "serve", "--port", str(port), *arguments], stdout=log, stderr=log)
        try:
            wait_until_ready(process, url, log_path)
            yield process, url
        finally:
            stop(process)


def stop(process: subprocess.Popen[bytes]) -> None:
    """Terminates the service, and kills it if that takes too long."""
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(timeout=30)
    except subprocess.TimeoutExpired:
        process.kill()


def wait_until_ready(
    process: subprocess.Popen[bytes], url: str, log_path: Path, tls: ssl.SSLContext | None = None
) -> None:
    """Returns when the networks are warm. Exits with the service's log if it does not get ready.

    `tls` is how to connect to a service with a certificate that the system does not trust.
    """
    end = time.monotonic() + READY_S
    while time.monotonic() < end and process.poll() is None:
        try:
            if httpx.get(f"{url}/readyz", verify=tls or True).is_success:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    sys.exit(f"error: the service did not get ready:\n{log_path.read_text()}")


def free_port() -> int:
    """Returns a port on which nothing listens at the moment."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else None))
    except KeyboardInterrupt:
        sys.exit(130)
