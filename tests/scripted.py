"""A service that plays a script: one act for each connection that comes, so that it breaks where a test wants it."""

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
from lanestream.protocol import DrainingMessage, SummaryMessage, error_message


class Visit:
    """One connection, from the service's side."""

    def __init__(self, connection: ServerConnection, script: Script) -> None:
        self._connection = connection
        self._script = script

    def open(self, **ready: Any) -> None:
        """Takes `start`, which the script keeps, and answers it."""
        text = self._connection.recv(fakes.WAIT_S)
        assert isinstance(text, str)
        self._script.starts.append(json.loads(text))
        self._connection.send(fakes.ready(**ready).model_dump_json())

    def frame(self) -> int:
        """Takes a frame, or the end; the frame's number, -1 for the end."""
        announced = json.loads(self._connection.recv(fakes.WAIT_S))
        if announced["type"] == "end":
            return -1
        assert isinstance(self._connection.recv(fakes.WAIT_S), bytes)
        return int(announced["seq"])

    def answer(self, *numbers: int) -> None:
        for seq in numbers:
            self._connection.send(fakes.lanes(seq).model_dump_json())

    def refuse(self, error: LanestreamError, seq: int | None = None) -> None:
        """Tells of an error: a frame's, or one that ends the stream."""
        self._connection.send(error_message(error, seq=seq, fatal=seq is None).model_dump_json())

    def drain(self) -> None:
        self._connection.send(DrainingMessage(resume_token="later", deadline_s=5.0).model_dump_json())  # noqa: S106

    def close(self, code: int) -> None:
        self._connection.close(code)

    def break_off(self) -> None:
        """Ends without a goodbye, as a process that is killed."""
        self._connection.socket.shutdown(socket.SHUT_RDWR)

    def finish(self) -> None:
        """Answers what comes until the end, as a service that is well."""
        while (seq := self.frame()) >= 0:
            self.answer(seq)
        self._connection.send(
            SummaryMessage(frames=0, answered=0, failed=0, dropped=0, duration_s=0.0).model_dump_json()
        )
        self._connection.close()


Act = Callable[[Visit], None] | LanestreamError


@dataclass
class Script:
    """The acts that are still to come, and what refuses every connection after them.

    It keeps what the clients began with, in which headers, and what went wrong.
    """

    acts: list[Act]
    then: LanestreamError | None = None
    url: str = ""
    starts: list[dict[str, Any]] = field(default_factory=list)
    headers: list[dict[str, str]] = field(default_factory=list)
    failures: list[BaseException] = field(default_factory=list)

    def receive(self, connection: ServerConnection, request: Request) -> Response | None:
        """Refuses the handshake where the act is an error, and lets it pass otherwise."""
        self.headers.append(dict(request.headers.raw_items()))
        act = self.acts[0] if self.acts else self.then
        assert act is not None, "nobody was to come any more"
        if not isinstance(act, LanestreamError):
            return None
        del self.acts[:1]
        body = json.dumps({"code": act.code, "message": act.message, "hint": act.hint})
        return connection.respond(HTTPStatus(wire_status(act).http_status), body)

    def play(self, connection: ServerConnection) -> None:
        """One connection."""
        act = self.acts.pop(0)
        assert not isinstance(act, LanestreamError)
        try:
            act(Visit(connection, self))
        except ConnectionClosed:
            pass  # as a client does that gives up
        except BaseException as error:
            self.failures.append(error)


@contextmanager
def scripted(*acts: Act, then: LanestreamError | None = None) -> Iterator[Script]:
    """A service that plays the acts in turn, then refuses with `then`.

    Fails where they were not all played, or one of them failed.
    """
    script = Script(list(acts), then)
    with serve(script.play, "127.0.0.1", 0, process_request=script.receive, compression=None) as server:
        script.url = f"http://127.0.0.1:{server.socket.getsockname()[1]}"
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield script
        finally:
            server.shutdown()
            thread.join(fakes.WAIT_S)
    assert script.failures == []
    assert script.acts == []


def refused_url() -> str:
    """The URL of a port that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return f"http://127.0.0.1:{probe.getsockname()[1]}"
