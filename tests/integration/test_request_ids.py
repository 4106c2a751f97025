"""Request ids over real sockets: in responses, in problems, in log records and in the errors of clients."""

from __future__ import annotations

import json
import re
import socket
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

import fakes
import httpx
import pytest
from fakes import image_file
from processes import log_lines
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from lanestream.errors import ImageError, LanestreamError, NoDetectorError
from lanestream.keys import new_key
from lanestream_client import AsyncLaneClient, LaneClient

Serve = Callable[..., str]

HEADER = "X-Request-ID"
GENERATED = re.compile(r"[0-9a-f]{16}")
TOKEN, KEY = new_key("camera-7")
LISTED = "https://lanes.example.com"


def stream_url(url: str) -> str:
    return f"{url.replace('http', 'ws')}/v1/stream"


@pytest.mark.parametrize(
    "given",
    ["7", "0f2c1a7e-93b4-4cf2-a3d3-6c1a7f1b2c3d", "Root=1-67891233-abcdef012345678912345678", "a" * 128, "q/w+e==:@._"],
)
def test_the_id_of_a_caller_is_kept(url: str, given: str) -> None:
    found = httpx.get(f"{url}/healthz", headers={HEADER: given})
    assert found.headers.get_list(HEADER) == [given]
    refused = httpx.post(f"{url}/v1/detect", content=b"no image", headers={HEADER: given})
    assert (refused.headers.get_list(HEADER), refused.json()["request_id"]) == ([given], given)


@pytest.mark.parametrize("given", ["", "two words", "a" * 129, 'a"b', "a,b", "a%0ab", "schl\u00fcssel", "${jndi:x}"])
def test_an_id_that_is_not_well_formed_is_replaced(url: str, given: str) -> None:
    found = httpx.get(f"{url}/nothing", headers={HEADER: given.encode("latin-1")})
    assert GENERATED.fullmatch(found.json()["request_id"])
    assert found.headers.get_list(HEADER) == [found.json()["request_id"]]


def test_requests_of_one_connection_have_different_ids(url: str) -> None:
    address = urlsplit(url)
    with socket.create_connection((address.hostname, address.port), fakes.WAIT_S) as connection:
        request = b"GET /healthz HTTP/1.1\r\nHost: h\r\n"
        named = request + b"X-Request-ID: mine\r\n\r\n"
        connection.sendall(named + request + b"\r\n" + request + b"Connection: close\r\n\r\n")
        answers = b"".join(iter(lambda: connection.recv(65536), b"")).decode()
    ids = re.findall(r"^x-request-id: (\S+)", answers, re.MULTILINE | re.IGNORECASE)
    assert ids[0] == "mine"
    assert len(set(ids)) == 3


def test_a_handshake_is_answered_with_the_id_if_it_is_accepted_and_if_it_is_refused(serve: Serve) -> None:
    guarded = stream_url(serve(fakes.engine(), api_keys=str(KEY)))
    with connect(guarded, additional_headers={"Authorization": f"Bearer {TOKEN}", HEADER: "mine"}) as stream:
        assert stream.response is not None
        assert stream.response.headers.get_all(HEADER) == ["mine"]
    with pytest.raises(InvalidStatus) as refused, connect(guarded, additional_headers={HEADER: "other"}):
        pass
    response = refused.value.response
    assert response.headers.get_all(HEADER) == ["other"]
    assert json.loads(response.body or b"")["request_id"] == "other"


def test_pages_of_other_origins_may_send_and_read_the_id(serve: Serve) -> None:
    url = serve(fakes.engine(), allowed_origins=LISTED)
    preflight = httpx.options(
        f"{url}/v1/models",
        headers={"Origin": LISTED, "Access-Control-Request-Method": "GET", "Access-Control-Request-Headers": HEADER},
    )
    assert preflight.status_code == 200
    found = httpx.get(f"{url}/v1/models", headers={"Origin": LISTED})
    assert found.headers["access-control-expose-headers"] == HEADER


def test_all_records_of_a_request_or_a_stream_have_its_id() -> None:
    def use(url: str) -> None:
        httpx.get(f"{url}/v1/models", headers={HEADER: "models-1"})
        httpx.get(f"{url}/v1/models", headers={HEADER: "forged\tevent"})
        options: dict[str, Any] = {"compression": None}
        with (
            connect(stream_url(url), additional_headers={HEADER: "stream-1"}, **options) as one,
            connect(stream_url(url), additional_headers={HEADER: "stream-2"}, **options) as other,
        ):
            for stream in (one, other):
                stream.send(json.dumps({"type": "start", "session": "same"}))
                assert json.loads(stream.recv(fakes.WAIT_S))["type"] == "ready"
            for seq in range(12):
                one.send(json.dumps({"type": "frame", "seq": seq, "timestamp": 40.0 * seq}))
                one.send(image_file())
                while json.loads(one.recv(fakes.WAIT_S))["type"] != "lanes":
                    pass

    records = [json.loads(line) for line in log_lines(["--log-format", "json"], {}, use)]
    events: dict[str, list[str]] = {}
    for record in records:
        events.setdefault(record.get("request_id", ""), []).append(record.get("event") or record["message"])
    assert not {"request", "stream_opened", "stream_closed", "client_warning"} & set(events.pop(""))
    assert events.pop("models-1") == ["request"]
    accepted, *of_stream = events.pop("stream-1")
    assert accepted.endswith('"WebSocket /v1/stream" [accepted]')
    assert of_stream == ["connection open", "stream_opened", "client_warning", "stream_closed"]
    assert events.pop("stream-2")[1:] == ["connection open", "stream_opened", "stream_closed"]
    ((generated, of_request),) = events.items()
    assert (bool(GENERATED.fullmatch(generated)), of_request) == (True, ["request"])
    assert "forged" not in json.dumps(records)


def test_text_lines_end_with_the_id() -> None:
    lines = log_lines([], {}, lambda url: httpx.get(f"{url}/v1/models", headers={HEADER: "models-1"}))
    assert [line for line in lines if line.endswith('"GET /v1/models HTTP/1.1" 200 request_id=models-1\n')]


def test_errors_of_the_blocking_client_name_the_request(serve: Serve) -> None:
    url = serve(fakes.engine())
    with LaneClient(url) as client:
        with pytest.raises(ImageError) as caught:
            client.detect(b"no image")
        assert GENERATED.fullmatch(caught.value.request_id or "")
        assert str(caught.value).endswith(f" [request {caught.value.request_id}]")
        with pytest.raises(NoDetectorError) as refused:
            list(client.stream([image_file()], detector="regression"))
        assert GENERATED.fullmatch(refused.value.request_id or "")
        assert refused.value.request_id != caught.value.request_id


async def test_errors_of_the_async_client_name_the_request(serve: Serve) -> None:
    url = serve(fakes.engine(), api_keys=str(KEY))
    async with AsyncLaneClient(url, api_key="lane_wrong") as client:
        with pytest.raises(LanestreamError, match=r" \[request [0-9a-f]{16}\]$"):
            await client.detect(b"no image")
        with pytest.raises(LanestreamError, match=r" \[request [0-9a-f]{16}\]$"):
            async for _ in client.stream([image_file()]):
                pass
    async with AsyncLaneClient(url, api_key=TOKEN) as client:
        with pytest.raises(NoDetectorError, match=r" \[request [0-9a-f]{16}\]$"):
            async for _ in client.stream([image_file()], detector="regression"):
                pass
