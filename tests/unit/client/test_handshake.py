"""How the failures of a socket are told."""

from __future__ import annotations

import json
import logging

import pytest
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.frames import Close
from websockets.http11 import Response

from lanestream.errors import (
    BusyError,
    ConnectionFailedError,
    EvictedError,
    ForbiddenError,
    IdleError,
    ImageTooLargeError,
    LanestreamError,
    ProtocolError,
    TooOldError,
    UnauthorizedError,
)
from lanestream_client.endpoint import Endpoint
from lanestream_client.handshake import lost, options, telling

PLACE = Endpoint.parse("http://h:8000", "hidden")


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (1002, ProtocolError),
        (1008, ProtocolError),
        (1009, ImageTooLargeError),
        (1011, ConnectionFailedError),
        (1012, ConnectionFailedError),
        (1013, ConnectionFailedError),
        (4001, EvictedError),
        (4002, IdleError),
        (4003, TooOldError),
    ],
)
def test_a_close_code_has_its_error(code: int, kind: type[LanestreamError]) -> None:
    assert type(lost(ConnectionClosedError(Close(code, ""), None))) is kind


def test_a_lost_connection_says_why() -> None:
    told = str(lost(ConnectionClosedError(Close(1011, "oops"), None)))
    assert told == "the service closed the stream with code 1011: oops"
    assert "broke" in str(lost(ConnectionClosedError(None, None)))


@pytest.mark.parametrize(
    ("status", "code", "kind"),
    [(401, "unauthorized", UnauthorizedError), (403, "forbidden", ForbiddenError), (503, "busy", BusyError)],
)
def test_a_refused_handshake_is_told_as_the_service_told_it(
    status: int, code: str, kind: type[LanestreamError]
) -> None:
    body = json.dumps({"code": code, "message": "no", "hint": "ask"}).encode()
    with pytest.raises(kind, match=r"no \(ask\)"), telling(PLACE):
        raise InvalidStatus(Response(status, "", Headers(), body))


@pytest.mark.parametrize("body", [b"", b"<html>", b"[]", b'{"code": 1}'])
def test_another_refusal_is_told_by_its_status(body: bytes) -> None:
    with pytest.raises(ConnectionFailedError, match="http://h:8000 answered 502 Bad Gateway"), telling(PLACE):
        raise InvalidStatus(Response(502, "", Headers(), body))


def test_what_websockets_logs_of_a_handshake_stays_out_of_the_logs(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    assert not options(PLACE, 1.0)["logger"].isEnabledFor(logging.DEBUG)
