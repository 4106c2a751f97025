"""Steps of the time of day, such as those of a machine whose clock is set. They need Debian's package `faketime`."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fakes
import pytest
from processes import service
from websockets.sync.client import ClientConnection
from wsclient import receive, send_message, stream

LIBRARY = "libfaketimeMT.so.1"
IDLE_S = 1.5


@pytest.fixture
def set_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Returns a function that sets the time of day of the services that the test starts, as an offset."""
    library = next(Path("/usr/lib").glob(f"*/faketime/{LIBRARY}"), None)
    if library is None:
        pytest.skip(f"{LIBRARY} is not installed (on Debian: apt install faketime)")
    offset = tmp_path / "offset"

    def set_offset(text: str) -> None:
        # Replaced as a whole, so that a service never reads half of it.
        (tmp_path / "new").write_text(text)
        (tmp_path / "new").replace(offset)

    set_offset("+0h")
    monkeypatch.setenv("LD_PRELOAD", str(library))
    monkeypatch.setenv("FAKETIME_TIMESTAMP_FILE", str(offset))
    monkeypatch.setenv("FAKETIME_NO_CACHE", "1")
    for name in ("FAKETIME_DONT_FAKE_MONOTONIC", "DONT_FAKE_MONOTONIC"):
        monkeypatch.setenv(name, "1")
    return set_offset


def answer(socket: ClientConnection) -> dict[str, Any]:
    socket.send(fakes.image_file())
    return receive(socket)


def test_steps_of_the_clock_end_no_stream_and_lose_no_session(set_clock: Callable[[str], None]) -> None:
    with service(processes=0, regressor="none", idle_s=IDLE_S) as (_, url):
        token, latest = None, 0.0
        for step in ("+25h", "-25h", "+0h"):
            with stream(url) as socket:
                send_message(socket, "start", mode="all", resume_token=token)
                ready = receive(socket)
                assert ready["resumed"] == (token is not None), ready
                token = ready["resume_token"]
                set_clock(step)
                # The age of a session is checked when it might have been idle for too long.
                end = time.monotonic() + 1.3 * IDLE_S
                while time.monotonic() < end:
                    lanes = answer(socket)
                    assert lanes["type"] == "lanes", lanes
                    assert latest < lanes["timestamp"] < latest + fakes.WAIT_S, "the stream's own clock goes on"
                    latest = lanes["timestamp"]
                    fakes.pause(0.1)


def test_the_clock_of_a_service_can_be_set(set_clock: Callable[[str], None]) -> None:
    command = [sys.executable, "-c", "import time; print(time.time())"]
    set_clock("+25h")
    now = float(subprocess.run(command, check=True, capture_output=True).stdout)
    assert now - time.time() == pytest.approx(25 * 3600.0, abs=fakes.WAIT_S)
