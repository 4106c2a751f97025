"""A fake service that follows a script: one step for each connection, so that it fails where a test wants it to."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any

import fakes
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

from lanestream.errors import LanestreamError, wire_status
from lanestream.protocol import DrainingMessage, ServerMessage, SummaryMessage, error_message


class ScriptedConnection:
    """The service's side of one connection."""

    def __init__(self, connection: ServerConnection, script: Script) -> None:
        self._connection = connection
        self._script = script

    def open(self, **ready: Any) -> None:
        """Receives `start`, records it in the script and answers `ready`."""
        text = self._connection.recv(fakes.WAIT_S)
        assert isinstance(text, str)
        self._script.starts.append(json.loads(text))
        self._connection.send(fakes.ready(**ready).model_dump_json())

    def receive_frame(self) -> int:
        """Receives a frame and returns its number. Returns -1 for `end`."""
        header = json.loads(self._connection.recv(fakes.WAIT_S))
        if header["type"] == "end":
            return -1
        assert isinstance(self._connection.recv(fakes.WAIT_S), bytes)
        return int(header["seq"])

    def send_lanes(self, *numbers: int) -> None:
        """Answers frames."""
        for seq in numbers:
            self.send(fakes.lanes(seq))

    def send(self, message: ServerMessage) -> None:
        """Sends any message."""
        self._connection.send(message.model_dump_json())

    def send_error(self, error: LanestreamError, seq: int | None = None) -> None:
        """Sends the error of a frame, or one that ends the stream if `seq` is None."""
        self._connection.send(error_message(error, seq=seq, fatal=seq is None).model_dump_json())

    def drain(self) -> None:
        """Announces that the service is about to stop."""
        self._connection.send(DrainingMessage(resume_token="later", deadline_s=5.0).model_dump_json())  # noqa: S106

    def close(self, code: int) -> None:
        """Closes the connection properly."""
        self._connection.close(code)

    def break_off(self) -> None:
        """Breaks the connection without a close frame, as a killed process does."""
        self._connection.socket.shutdown(socket.SHUT_RDWR)

    def finish(self) -> None:
        """Answers all frames until `end`, then sends the summary and closes."""
        while (seq := self.receive_frame()) >= 0:
            self.send_lanes(seq)
        self._connection.send(
            SummaryMessage(frames=0, answered=0, failed=0, dropped=0, duration_s=0.0).model_dump_json()
        )
        self._connection.close()


# Handles a connection, or refuses its handshake with an error.
ScriptStep = Callable[[ScriptedConnection], None] | LanestreamError


@dataclass
class Script:
    """The remaining steps, and the error that refuses every connection after them.

    Records the clients' `start` messages and handshake headers, and the exceptions of steps.
    """

    steps: list[ScriptStep]
    refuse_later: LanestreamError | None = None
    url: str = ""
    starts: list[dict[str, Any]] = field(default_factory=list)
    headers: list[dict[str, str]] = field(default_factory=list)
    failures: list[BaseException] = field(default_factory=list)

    def process_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Refuses the handshake if the next step is an error."""
        self.headers.append(dict(request.headers.raw_items()))
        step = self.steps[0] if self.steps else self.refuse_later
        assert step is not None, "unexpected connection"
        if not isinstance(step, LanestreamError):
            return None
        del self.steps[:1]
        body = json.dumps({"code": step.code, "message": step.message, "hint": step.hint})
        return connection.respond(HTTPStatus(wire_status(step).http_status), body)

    def handle(self, connection: ServerConnection) -> None:
        """Runs the next step on a connection."""
        step = self.steps.pop(0)
        assert not isinstance(step, LanestreamError)
        try:
            step(ScriptedConnection(connection, self))
        except ConnectionClosed:
            pass  # the client may give up
        except BaseException as error:
            self.failures.append(error)


@contextmanager
def scripted(*steps: ScriptStep, refuse_later: LanestreamError | None = None) -> Iterator[Script]:
    """Runs a service that follows the steps, then refuses connections with `refuse_later`.

    Fails if a step failed or was not reached.
    """
    script = Script(list(steps), refuse_later)
    with serve(script.handle, "127.0.0.1", 0, process_request=script.process_request, compression=None) as server:
        script.url = f"http://127.0.0.1:{server.socket.getsockname()[1]}"
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield script
        finally:
            server.shutdown()
            thread.join(fakes.WAIT_S)
    assert script.failures == []
    assert script.steps == []


def refused_url() -> str:
    """Returns the URL of a port that no process listens on."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return f"http://127.0.0.1:{probe.getsockname()[1]}"
