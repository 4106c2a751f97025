"""API keys that change while the service runs: added, removed, invalid, and read again on SIGHUP."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path

import fakes
import httpx
import processes
import pytest
from websockets.exceptions import ConnectionClosedError
from websockets.sync.client import connect

from lanestream.keys import new_key

ONE, ONE_KEY = new_key("camera-1")
TWO, TWO_KEY = new_key("camera-2")


def _status(url: str, token: str) -> int:
    return httpx.get(f"{url}/v1/models", headers={"authorization": f"Bearer {token}"}).status_code


def _wait_for_status(url: str, token: str, status: int) -> None:
    deadline = time.monotonic() + fakes.WAIT_S
    while _status(url, token) != status:
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_keys_change_while_the_service_runs(tmp_path: Path) -> None:
    file = tmp_path / "keys"
    file.write_text(f"{ONE_KEY}\n")
    with processes.service(api_keys_file=file) as (process, url):
        stream_url = f"{url.replace('http', 'ws')}/v1/stream"
        with connect(stream_url, additional_headers={"authorization": f"Bearer {ONE}"}) as removed:
            removed.send(json.dumps({"type": "start"}))
            removed.recv(fakes.WAIT_S)
            assert (_status(url, ONE), _status(url, TWO)) == (200, 401)

            file.write_text(f"{ONE_KEY}\n{TWO_KEY}\n")
            _wait_for_status(url, TWO, 200)
            with connect(stream_url, additional_headers={"authorization": f"Bearer {TWO}"}) as kept:
                # A new file in the place of the old one, as orchestrators do it.
                (tmp_path / "new").write_text(f"{TWO_KEY}\n")
                (tmp_path / "new").replace(file)
                error = json.loads(removed.recv(fakes.WAIT_S))
                assert (error["type"], error["code"], error["fatal"]) == ("error", "unauthorized", True)
                with pytest.raises(ConnectionClosedError) as closed:
                    removed.recv(fakes.WAIT_S)
                assert closed.value.rcvd is not None
                assert closed.value.rcvd.code == 1008
                assert _status(url, ONE) == 401
                kept.send(fakes.image_file())
                assert json.loads(kept.recv(fakes.WAIT_S))["type"] == "lanes"

        file.write_text("camera-1: what?\n")
        assert process.stderr is not None
        for line in process.stderr:
            if "ERROR" in line:
                break
        assert "the API keys stay as they were" in line
        assert "line 1 is not a valid key" in line
        assert _status(url, TWO) == 200

        process.send_signal(signal.SIGHUP)
        for line in process.stderr:
            if "ERROR" in line:
                break
        assert "line 1 is not a valid key" in line
        process.send_signal(signal.SIGTERM)
        assert process.wait(fakes.WAIT_S) == -signal.SIGTERM
