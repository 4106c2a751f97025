"""Service URLs, API keys, and the errors that failed connections become."""

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
    SettingsError,
    TooOldError,
    UnauthorizedError,
)
from lanestream_client import AsyncLaneClient, LaneClient
from lanestream_client.endpoint import Endpoint, closed_error, connect_options, parse_endpoints, websocket_errors

ENDPOINT = Endpoint.parse("http://h:8000", "hidden")


@pytest.mark.parametrize(
    ("url", "http", "stream"),
    [
        ("http://h:8000", "http://h:8000", "ws://h:8000/v1/stream"),
        ("h:8000", "http://h:8000", "ws://h:8000/v1/stream"),
        ("h:8000/", "http://h:8000", "ws://h:8000/v1/stream"),
        ("https://h/", "https://h", "wss://h/v1/stream"),
        ("ws://h:1/v1/stream", "http://h:1", "ws://h:1/v1/stream"),
        ("wss://h/below/v1/stream", "https://h/below", "wss://h/below/v1/stream"),
        ("https://h/behind/proxy/", "https://h/behind/proxy", "wss://h/behind/proxy/v1/stream"),
        ("http://[::1]:9", "http://[::1]:9", "ws://[::1]:9/v1/stream"),
    ],
)
def test_one_url_serves_requests_and_streams(url: str, http: str, stream: str) -> None:
    endpoint = Endpoint.parse(url)
    assert (endpoint.base, endpoint.http, endpoint.stream, endpoint.headers) == (url, http, stream, {})


@pytest.mark.parametrize("url", ["", "ftp://a", "http://", "http:///x", "http://[::1", "http://a:99999", "a:b"])
def test_an_invalid_url_is_refused(url: str) -> None:
    with pytest.raises(SettingsError, match="not a valid service URL"):
        Endpoint.parse(url)


def test_several_replicas() -> None:
    assert [endpoint.base for endpoint in parse_endpoints(["http://a", "http://b"])] == ["http://a", "http://b"]
    with pytest.raises(SettingsError, match="no service URL was given"):
        parse_endpoints([])
    with pytest.raises(SettingsError, match="'ftp://b' is not a valid service URL"):
        parse_endpoints(["http://a", "ftp://b"])


def test_a_key_appears_only_in_the_header() -> None:
    (endpoint,) = parse_endpoints("http://user:hidden@h", "hidden")
    assert endpoint.headers == {"Authorization": "Bearer hidden"}
    assert endpoint.base == "http://h"
    for url in ("http://user:hid/den@h", "http://user:hid#den@h", "user:hid?den@h"):
        with pytest.raises(SettingsError) as caught:
            Endpoint.parse(url)
        assert "den" not in str(caught.value)
    for client in (LaneClient, AsyncLaneClient):
        assert "hidden" not in repr(endpoint) + repr(client("http://h", api_key="hidden"))


@pytest.mark.parametrize("key", ["", "two words", "line\nbreak", "schl\u00fcssel"])
def test_a_key_that_no_header_can_carry_is_refused_without_printing_it(key: str) -> None:
    with pytest.raises(SettingsError, match="the API key can't be sent") as caught:
        LaneClient(api_key=key)
    assert not key or key not in str(caught.value)


def test_an_invalid_url_is_reported_without_its_password() -> None:
    with pytest.raises(SettingsError) as caught:
        LaneClient("ftp://user:hidden@h")
    assert "ftp://h" in str(caught.value)
    assert "hidden" not in str(caught.value)


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
    assert type(closed_error(ConnectionClosedError(Close(code, ""), None))) is kind


def test_a_closed_connection_says_why() -> None:
    text = str(closed_error(ConnectionClosedError(Close(1011, "oops"), None)))
    assert text == "the service closed the stream with code 1011: oops"
    assert "broke" in str(closed_error(ConnectionClosedError(None, None)))


@pytest.mark.parametrize(
    ("status", "code", "kind"),
    [(401, "unauthorized", UnauthorizedError), (403, "forbidden", ForbiddenError), (503, "busy", BusyError)],
)
def test_a_refused_handshake_raises_the_error_that_the_service_sent(
    status: int, code: str, kind: type[LanestreamError]
) -> None:
    body = json.dumps({"code": code, "message": "no", "hint": "ask"}).encode()
    with pytest.raises(kind, match=r"no \(ask\)"), websocket_errors(ENDPOINT):
        raise InvalidStatus(Response(status, "", Headers(), body))


@pytest.mark.parametrize("body", [b"", b"<html>", b"[]", b'{"code": 1}'])
def test_a_refusal_by_another_server_is_reported_by_its_status(body: bytes) -> None:
    with (
        pytest.raises(ConnectionFailedError, match="http://h:8000 answered 502 Bad Gateway"),
        websocket_errors(ENDPOINT),
    ):
        raise InvalidStatus(Response(502, "", Headers(), body))


def test_debug_messages_of_websockets_stay_out_of_the_logs(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    assert not connect_options(ENDPOINT, 1.0)["logger"].isEnabledFor(logging.DEBUG)
