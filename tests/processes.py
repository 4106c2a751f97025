"""Services in separate processes, which can be stopped and killed."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import fakes
import psutil


@contextmanager
def service(port: int = 0, **settings: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Runs a service in a separate process and yields the process and its URL once it is ready.

    It listens on `port`, by default a free one.
    """
    environment = {f"LANESTREAM_{name.upper()}": str(value) for name, value in settings.items()}
    command = [sys.executable, "-m", "lanestream.cli", "serve", "--port", str(port), "--provider", "cpu"]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, env={**os.environ, **environment}
    ) as process:
        try:
            assert process.stderr is not None
            url = ""
            for line in process.stderr:
                url = url or "".join(re.findall(r"listening on (\S+),", line))
                if line.rstrip().endswith(" ready"):
                    break
            yield process, url
        finally:
            process.kill()


def commands_of_run(value: str) -> list[str]:
    """Returns the commands of all processes whose TEST_RUN is `value`, even if their parent has ended."""
    commands = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            if process.environ().get("TEST_RUN") == value:
                commands.append(" ".join(process.cmdline()))
    return commands


def log_lines(arguments: list[str], settings: dict[str, str], use: Callable[[str], None]) -> list[str]:
    """Returns the lines that `lanestream serve` logs while `use` is called with its URL."""
    command = [sys.executable, "-m", "lanestream.cli", "serve", "--port", "0", "--provider", "cpu", *arguments]
    environment = {**os.environ, **settings}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stderr is not None
        lines: list[str] = []
        try:
            for line in process.stderr:
                lines.append(line)
                if "listening on" in line:
                    url = line.split("listening on ")[1].split(",")[0]
                if '"ready"' in line or line.endswith(": ready\n"):
                    break
            use(url.replace("0.0.0.0", "127.0.0.1"))  # noqa: S104
            process.send_signal(signal.SIGINT)
            output, errors = process.communicate(timeout=fakes.WAIT_S)
        finally:
            process.kill()
    assert output == ""
    return [*lines, *errors.splitlines(keepends=True)]
