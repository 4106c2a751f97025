"""`make demo`: a clip through a service of its own, as a user would send it; results under out/.

Without a video it renders one. The service runs on a free port, is waited for until it is ready, and is stopped
whatever happens.
"""

from __future__ import annotations

import signal
import socket
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
    """Runs the demo; the exit code is that of the stream."""
    OUT.mkdir(exist_ok=True)
    if video is None:
        video = str(OUT / "scene.mp4")
        print(f"rendering {video}", flush=True)
        code = subprocess.run([LANESTREAM, "scene", video, "--lane-change"], check=False).returncode
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
    """A service on a free port, by its URL, started with further `arguments`; its log goes to `log_path`."""
    with service_process(log_path, *arguments) as (_, url):
        yield url


@contextmanager
def service_process(log_path: Path, *arguments: str | Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """The same, with its process."""
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
    """Asks the service to end, and ends it where it does not."""
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(timeout=30)
    except subprocess.TimeoutExpired:
        process.kill()


def wait_until_ready(process: subprocess.Popen[bytes], url: str, log_path: Path) -> None:
    """Returns when the network is warm; exits with what the service said where it does not come up."""
    end = time.monotonic() + READY_S
    while time.monotonic() < end and process.poll() is None:
        try:
            if httpx.get(f"{url}/readyz").is_success:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    sys.exit(f"error: the service did not come up:\n{log_path.read_text()}")


def free_port() -> int:
    """A port that nobody listens on just now."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else None))
    except KeyboardInterrupt:
        sys.exit(130)
