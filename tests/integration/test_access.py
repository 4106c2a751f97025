"""Access over real sockets: keys, origins, and public routes."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fakes
import httpx
import jwt
import pytest
from fastapi.routing import APIRoute
from processes import log_lines
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect
from wsclient import wait_until_released

from lanestream.api import create_app
from lanestream.api.auth import Authenticator, warn_if_open
from lanestream.errors import SettingsError
from lanestream.keys import ApiKey, new_key
from lanestream.settings import Settings

Serve = Callable[..., str]

TOKEN, KEY = new_key("camera-7")
OTHER_TOKEN, OTHER_KEY = new_key("camera-8")
FOREIGN = "https://evil.example"
LISTED = "https://lanes.example.com"
PUBLIC_PATHS = {"/healthz", "/readyz", "/v1/schema", "/v1/asyncapi.json"}


@pytest.fixture
def guarded(serve: Serve) -> str:
    """Returns the URL of a service that requires one of two keys."""
    return serve(fakes.engine(), api_keys=f"{KEY},{OTHER_KEY}", allowed_origins=LISTED)


def bearer(token: str, scheme: str = "Bearer") -> dict[str, str]:
    return {"authorization": f"{scheme} {token}"}


def send_frame(url: str, **options: Any) -> str | None:
    """Streams a frame and returns the selected subprotocol. Raises InvalidStatus if the handshake is refused."""
    with connect(f"{url.replace('http', 'ws')}/v1/stream", compression=None, **options) as socket:
        socket.send(fakes.image_file())
        assert json.loads(socket.recv(fakes.WAIT_S))["type"] == "lanes"
        return socket.subprotocol


def refused_handshake(url: str, **options: Any) -> tuple[int, str, str | None]:
    """Returns the status, code and challenge of a handshake that is refused."""
    with pytest.raises(InvalidStatus) as caught:
        send_frame(url, **options)
    response = caught.value.response
    problem = json.loads(response.body)
    assert set(problem) == {"code", "message", "hint", "request_id"}
    return response.status_code, problem["code"], response.headers.get("www-authenticate")


@pytest.mark.parametrize("token", [TOKEN, OTHER_TOKEN], ids=["one", "other"])
def test_a_key_grants_access_to_requests_and_streams(guarded: str, token: str) -> None:
    for headers in (bearer(token), bearer(token, "bearer"), bearer(f" {token}")):
        assert httpx.post(f"{guarded}/v1/detect", content=fakes.image_file(), headers=headers).status_code == 200
        assert send_frame(guarded, additional_headers=headers) is None
        assert send_frame(guarded, additional_headers=headers, subprotocols=["lanestream.v1"]) == "lanestream.v1"


def test_a_key_offered_as_a_subprotocol_is_never_selected(guarded: str) -> None:
    key = f"bearer.{TOKEN}"
    assert send_frame(guarded, subprotocols=["lanestream.v1", key]) == "lanestream.v1"
    assert send_frame(guarded, subprotocols=[key, "lanestream.v1"]) == "lanestream.v1"
    assert send_frame(guarded, subprotocols=[key]) is None


WRONG_HEADERS = [
    {},
    {"authorization": "Bearer"},
    {"authorization": TOKEN},
    bearer(TOKEN[:-1]),
    bearer(TOKEN + "x"),
    bearer(KEY.digest),
    bearer(str(KEY)),
    bearer(TOKEN, "Basic"),
]


@pytest.mark.parametrize("headers", WRONG_HEADERS, ids=range(len(WRONG_HEADERS)))
def test_requests_and_streams_without_a_valid_key_are_refused(guarded: str, headers: dict[str, str]) -> None:
    response = httpx.post(f"{guarded}/v1/detect?key={TOKEN}&horizon=9", content=b"no image", headers=headers)
    assert (response.status_code, response.json()["code"]) == (401, "unauthorized")
    assert response.headers["www-authenticate"] == "Bearer"
    assert refused_handshake(guarded, additional_headers=headers) == (401, "unauthorized", "Bearer")


@pytest.mark.parametrize(
    "offered", ["bearer.", f"bearer.{TOKEN}x", TOKEN, f"Bearer.{TOKEN}"], ids=["empty", "longer", "bare", "upper case"]
)
def test_an_invalid_subprotocol_is_not_a_key(guarded: str, offered: str) -> None:
    assert refused_handshake(guarded, subprotocols=["lanestream.v1", offered])[:2] == (401, "unauthorized")


def test_a_subprotocol_does_not_replace_a_wrong_header(guarded: str) -> None:
    assert refused_handshake(guarded, additional_headers=bearer("x"), subprotocols=[f"bearer.{TOKEN}"])[0] == 401


def test_every_route_is_guarded_except_public_ones() -> None:
    app = create_app(fakes.engine(), Settings(api_keys=str(KEY)))
    schema = app.openapi()
    assert schema["components"]["securitySchemes"]["HTTPBearer"]["scheme"] == "bearer"
    guarded = {path for path, item in schema["paths"].items() if all("security" in method for method in item.values())}
    assert set(schema["paths"]) - guarded == PUBLIC_PATHS
    assert {"/v1/detect", "/v1/models", "/metrics"} <= guarded
    assert all(isinstance(route, APIRoute) for route in app.routes if getattr(route, "path", "") in guarded)
    without_keys = create_app(fakes.engine(), Settings()).openapi()
    assert "securitySchemes" not in without_keys["components"]


def test_documented_guards_are_enforced(guarded: str) -> None:
    for path, methods in httpx.get(f"{guarded}/openapi.json").json()["paths"].items():
        for method in methods:
            status = httpx.request(method, f"{guarded}{path}").status_code
            assert (status == 200) == (path in PUBLIC_PATHS), path
            assert status in (200, 401), path
    assert httpx.get(f"{guarded}/docs").status_code == 200


@pytest.mark.parametrize(
    "path", ["/v1/models/", "//v1/models", "/v1/./models", "/v1%2fmodels", "/healthz/../v1/models"]
)
def test_no_spelling_of_a_path_evades_the_guard(guarded: str, path: str) -> None:
    port = int(guarded.rpartition(":")[2])
    with httpx.Client() as client:
        for host in (f"127.0.0.1:{port}", "x/healthz?", "x/healthz#"):
            request = client.build_request("GET", guarded, headers={"host": host})
            request.url = request.url.copy_with(raw_path=path.encode())
            assert client.send(request, follow_redirects=False).status_code in (307, 400, 401, 404)


@pytest.mark.parametrize("keys", [None, str(KEY)], ids=["no keys", "keys"])
def test_a_page_of_a_foreign_origin_is_refused_before_the_handshake(serve: Serve, keys: str | None) -> None:
    url = serve(fakes.engine(), allowed_origins=LISTED, **({"api_keys": keys} if keys else {}))
    port = url.rpartition(":")[2]
    options: dict[str, Any] = {"additional_headers": bearer(TOKEN)}
    foreign = (
        FOREIGN,
        "null",
        "file://",
        "http://127.0.0.1",
        f"http://localhost:{port}",
        f"{LISTED}:8443",
        f"{LISTED}.x",
    )
    for origin in foreign:
        assert refused_handshake(url, origin=origin, **options) == (403, "forbidden", None)
    for origin in (LISTED, url, url.replace("http", "https")):
        send_frame(url, origin=origin, **options)
    response = httpx.post(f"{url}/v1/detect", content=fakes.image_file(), headers={**bearer(TOKEN), "origin": FOREIGN})
    assert (response.status_code, response.json()["code"]) == (403, "forbidden")


@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        ("lanes.test", "https://lanes.test", 200),
        ("lanes.test:443", "https://lanes.test", 200),
        ("LANES.test", "http://lanes.test:80", 200),
        ("[::1]:8000", "http://[::1]:8000", 200),
        ("lanes.test", "https://lanes.test:8443", 403),
        ("lanes.test:80", "https://lanes.test", 403),
        ("lanes.test", "http://[lanes.test", 403),
        ("lanes.test", "http://lanes.test:x", 403),
        ("", "null", 403),
        ("", "http://", 403),
    ],
)
def test_own_pages_are_recognized_by_host_and_port(guarded: str, host: str, origin: str, status: int) -> None:
    headers = {"host": host, "origin": origin, **bearer(TOKEN)}
    assert httpx.get(f"{guarded}/v1/models", headers=headers).status_code == status


@pytest.mark.parametrize(
    ("host", "status"), [("localhost:1", 200), ("10.0.0.7", 200), ("[::1]:1", 200), ("lanes.test", 403)]
)
def test_without_keys_pages_opened_by_a_dns_name_are_refused(url: str, host: str, status: int) -> None:
    headers = {"host": host, "origin": f"http://{host}"}
    assert httpx.get(f"{url}/v1/models", headers=headers).status_code == status


def test_pages_of_listed_origins_may_read_responses(guarded: str) -> None:
    preflight = {"access-control-request-method": "POST", "access-control-request-headers": "authorization"}
    for origin, allowed in ((LISTED, LISTED), (FOREIGN, None)):
        headers = {"origin": origin, **bearer(TOKEN)}
        responses = [
            httpx.options(f"{guarded}/v1/detect", headers={**preflight, "origin": origin}),
            httpx.post(f"{guarded}/v1/detect", content=fakes.image_file(), headers=headers),
            httpx.get(f"{guarded}/v1/models", headers={"origin": origin}),
        ]
        for response in responses:
            assert response.headers.get("access-control-allow-origin") == allowed
            assert "access-control-allow-credentials" not in response.headers
        assert [response.status_code for response in responses] == ([200, 200, 401] if allowed else [400, 403, 403])


@pytest.mark.parametrize(
    ("access", "without_key", "with_key"), [("keys", 401, 200), ("open", 200, 200), ("off", 404, 404)]
)
def test_access_to_metrics_is_a_setting(serve: Serve, access: str, without_key: int, with_key: int) -> None:
    url = serve(fakes.engine(), api_keys=str(KEY), metrics_access=access)
    assert httpx.get(f"{url}/metrics").status_code == without_key
    assert httpx.get(f"{url}/metrics", headers=bearer(TOKEN)).status_code == with_key


def test_refusals_are_counted(guarded: str) -> None:
    httpx.get(f"{guarded}/v1/models")
    refused_handshake(guarded)
    refused_handshake(guarded, origin=FOREIGN)
    metrics = httpx.get(f"{guarded}/metrics", headers=bearer(TOKEN)).text
    assert 'lane_refusals_total{code="unauthorized"} 2.0' in metrics
    assert 'lane_refusals_total{code="forbidden"} 1.0' in metrics


def test_keys_are_also_read_from_a_file(serve: Serve, tmp_path: Path) -> None:
    (tmp_path / "keys").write_text(f"# cameras\n{KEY}\n")
    url = serve(fakes.engine(), api_keys=str(OTHER_KEY), api_keys_file=tmp_path / "keys")
    for token in (TOKEN, OTHER_TOKEN):
        assert httpx.get(f"{url}/v1/models", headers=bearer(token)).status_code == 200
    (tmp_path / "keys").write_text("camera-7: what?\n")
    with pytest.raises(SettingsError, match="line 1 is not a valid key"):
        create_app(None, Settings(api_keys_file=tmp_path / "keys"))


def test_the_key_command_creates_valid_keys(serve: Serve) -> None:
    completed = subprocess.run(
        [sys.executable, "-m", "lanestream.cli", "key", "camera-9"],
        capture_output=True,
        text=True,
        check=True,
        timeout=30,
    )
    output = dict(line.split(": ", 1) for line in completed.stdout.splitlines())
    token, setting = output["key"].strip(), output["setting"].strip()
    assert setting.startswith("camera-9:")
    assert token not in setting
    url = serve(fakes.engine(), api_keys=setting)
    assert httpx.get(f"{url}/v1/models", headers=bearer(token)).status_code == 200


SECRET = "signs tokens " * 4
PAGE = {"origin": LISTED}


def issue(url: str, credential: str) -> httpx.Response:
    return httpx.post(f"{url}/v1/tokens", headers=bearer(credential))


def test_a_token_is_used_like_the_key_it_was_issued_for(guarded: str) -> None:
    response = issue(guarded, TOKEN)
    assert (response.status_code, response.json()["expires_s"]) == (200, 600.0)
    token = response.json()["token"]
    assert httpx.get(f"{guarded}/v1/models", headers={**bearer(token), **PAGE}).status_code == 200
    assert send_frame(guarded, subprotocols=["lanestream.v1", f"bearer.{token}"], origin=LISTED) == "lanestream.v1"


def test_a_token_counts_as_the_caller_of_its_key(guarded: str) -> None:
    token = issue(guarded, TOKEN).json()["token"]
    stream_url = f"{guarded.replace('http', 'ws')}/v1/stream"
    with connect(stream_url, additional_headers=bearer(TOKEN)) as socket:
        resume_token = start(socket)["resume_token"]
    for credential, resumed in ((OTHER_TOKEN, False), (token, True)):
        with connect(stream_url, additional_headers=bearer(credential)) as socket:
            assert start(socket, resume_token=resume_token)["resumed"] is resumed


def test_only_a_key_is_exchanged_for_a_token(guarded: str, url: str) -> None:
    token = issue(guarded, TOKEN).json()["token"]
    for credential in (token, TOKEN + "x", KEY.digest):
        assert (issue(guarded, credential).status_code, issue(guarded, credential).json()["code"]) == (
            401,
            "unauthorized",
        )
    assert httpx.post(f"{guarded}/v1/tokens").status_code == 401
    assert httpx.post(f"{guarded}/v1/tokens", headers={**bearer(TOKEN), "origin": FOREIGN}).status_code == 403
    assert issue(url, TOKEN).json()["message"] == "this service requires no API key"


def test_forged_and_expired_tokens_are_refused(serve: Serve) -> None:
    url = serve(fakes.engine(), api_keys=str(KEY), token_secret=SECRET)
    now = int(time.time())
    valid = {"sub": KEY.name, "exp": now + 60}
    refused = [
        jwt.encode(valid, SECRET + "x", "HS256"),
        jwt.encode(valid, SECRET, "HS384"),
        jwt.encode(valid, None, "none"),
        jwt.encode({"sub": KEY.name}, SECRET, "HS256"),
        jwt.encode({"exp": now + 60}, SECRET, "HS256"),
        jwt.encode({**valid, "sub": "a-removed-key"}, SECRET, "HS256"),
    ]
    expired = jwt.encode({**valid, "exp": now - 60}, SECRET, "HS256")
    assert httpx.get(f"{url}/v1/models", headers=bearer(jwt.encode(valid, SECRET, "HS256"))).status_code == 200
    for token in (*refused, expired):
        response = httpx.get(f"{url}/v1/models", headers=bearer(token))
        assert (response.status_code, response.json()["code"]) == (401, "unauthorized"), token
        assert ("expired" in response.json()["message"]) == (token == expired)


def test_replicas_with_the_same_secret_accept_each_others_tokens(serve: Serve) -> None:
    def accepts(url: str, token: str) -> bool:
        return httpx.get(f"{url}/v1/models", headers=bearer(token)).status_code == 200

    settings = {"api_keys": str(KEY), "token_secret": SECRET}
    one, other, alone = (serve(fakes.engine(), **fields) for fields in (settings, settings, {"api_keys": str(KEY)}))
    token = issue(one, TOKEN).json()["token"]
    assert [accepts(url, token) for url in (one, other, alone)] == [True, True, False]
    own = issue(alone, TOKEN).json()["token"]
    assert [accepts(url, own) for url in (one, other, alone)] == [False, False, True]


def test_a_page_can_ask_why_its_handshake_fails(guarded: str, url: str, serve: Serve) -> None:
    def ask(base: str, headers: dict[str, str] | None = None, **query: str) -> tuple[int, str]:
        response = httpx.get(f"{base}/v1/stream", headers=headers, params=query)
        return response.status_code, response.json()["code"]

    assert ask(url) == (426, "upgrade_required")
    assert ask(guarded, bearer(TOKEN), origin=LISTED) == (426, "upgrade_required")
    assert ask(guarded, bearer(TOKEN + "x")) == (401, "unauthorized")
    assert ask(guarded) == (401, "unauthorized")
    assert ask(guarded, bearer(TOKEN), origin=FOREIGN) == (403, "forbidden")
    # A browser sends no origin with a GET to the page's own site, though it sends one with a handshake.
    assert ask(url, {"host": "lanes.test"}, origin="http://lanes.test") == (403, "forbidden")
    assert ask(serve(None)) == (503, "not_ready")
    assert httpx.get(f"{url}/v1/stream").headers["upgrade"] == "websocket"


def _with_key(token: str, *, in_header: bool) -> dict[str, Any]:
    return (
        {"additional_headers": bearer(token)} if in_header else {"subprotocols": ["lanestream.v1", f"bearer.{token}"]}
    )


def start(socket: ClientConnection, **fields: str) -> dict[str, Any]:
    """Sends `start` and returns the reply."""
    socket.send(json.dumps({"type": "start", **fields}))
    reply: dict[str, Any] = json.loads(socket.recv(fakes.WAIT_S))
    return reply


def test_sessions_belong_to_a_key_and_are_limited_per_key(serve: Serve) -> None:
    url = serve(fakes.engine(), api_keys=f"{KEY},{OTHER_KEY}", max_sessions_per_caller=1)
    stream_url = f"{url.replace('http', 'ws')}/v1/stream"
    with connect(stream_url, additional_headers=bearer(TOKEN)) as mine:
        token = start(mine)["resume_token"]
        with connect(stream_url, additional_headers=bearer(TOKEN)) as second:
            assert start(second)["code"] == "busy"
        with connect(stream_url, additional_headers=bearer(OTHER_TOKEN)) as theirs:
            assert start(theirs, resume_token=token)["resumed"] is False
        mine.send(fakes.image_file())
        assert json.loads(mine.recv(fakes.WAIT_S))["type"] == "lanes", "the first session is not affected"
    wait_until_released(url, **bearer(TOKEN))
    with connect(stream_url, additional_headers=bearer(TOKEN)) as again:
        assert start(again, resume_token=token)["resumed"] is True


def test_a_forwarded_address_counts_only_if_it_comes_from_a_trusted_proxy(
    serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    def answers(url: str) -> list[str]:
        stream_url = f"{url.replace('http', 'ws')}/v1/stream"
        with (
            connect(stream_url, additional_headers={"X-Forwarded-For": "192.0.2.1"}) as one,
            connect(stream_url, additional_headers={"X-Forwarded-For": "192.0.2.2"}) as other,
        ):
            return [start(one)["type"], start(other)["type"]]

    monkeypatch.delenv("FORWARDED_ALLOW_IPS", raising=False)
    assert answers(serve(fakes.engine(), max_sessions_per_caller=1)) == ["ready", "error"]
    monkeypatch.setenv("FORWARDED_ALLOW_IPS", "127.0.0.0/8")
    assert answers(serve(fakes.engine(), max_sessions_per_caller=1)) == ["ready", "ready"]


@pytest.mark.parametrize("path", ["/redoc", "/docs/oauth2-redirect/../redoc"])
def test_no_page_loads_scripts_from_elsewhere(url: str, path: str) -> None:
    assert httpx.get(url + path).status_code == 404


def test_keys_are_never_logged() -> None:
    wrong = "lane_an-unknown-key"

    def use(url: str) -> None:
        for token in (TOKEN, wrong):
            httpx.get(f"{url}/v1/models?key={token}", headers=bearer(token))
        for in_header in (True, False):
            send_frame(url, **_with_key(TOKEN, in_header=in_header))
            assert refused_handshake(url, **_with_key(wrong, in_header=in_header))[0] == 401
        with pytest.raises(InvalidStatus), connect(f"{url.replace('http', 'ws')}/v1/stream?key={TOKEN}"):
            pass

    lines = log_lines(["--log-format", "json", "--log-level", "debug"], {"LANESTREAM_API_KEYS": str(KEY)}, use)
    records = [json.loads(line) for line in lines]
    assert all({"time", "level", "logger", "message"} <= set(record) for record in records)
    assert {record["logger"] for record in records} >= {"lanestream.api.server", "uvicorn.access", "uvicorn.error"}
    assert not [record for record in records if record["level"] in ("WARNING", "ERROR")]
    messages = "\n".join(record["message"] for record in records)
    assert '"GET /v1/models HTTP/1.1" 401' in messages
    assert '"WebSocket /v1/stream" 401' in messages
    assert "camera-7" in messages
    for secret in (TOKEN, KEY.digest, wrong):
        assert secret not in "".join(lines)
    by_event = {record["event"]: record for record in records if "event" in record}
    assert by_event.keys() == {"listening", "detector_loaded", "ready", "request", "stream_opened", "stream_closed"}
    assert by_event["stream_opened"]["caller"] == "camera-7"
    assert by_event["stream_closed"]["session"] == by_event["stream_opened"]["session"]
    assert {name: by_event["stream_closed"][name] for name in ("frames", "answered", "dropped")} == {
        "frames": 1,
        "answered": 1,
        "dropped": 0,
    }


def test_a_service_without_keys_logs_a_warning() -> None:
    lines = log_lines(["--host", "0.0.0.0"], {}, lambda url: None)  # noqa: S104
    (warning,) = [line for line in lines if " WARNING " in line]
    assert "NO API KEYS: everyone who can reach 0.0.0.0 may use this service" in warning
    assert "lanestream key NAME" in warning


@pytest.mark.parametrize(("keys", "loopback"), [((KEY,), False), ((KEY,), True), ((), True)], ids=range(3))
def test_a_service_with_keys_or_on_loopback_logs_no_warning(
    caplog: pytest.LogCaptureFixture, keys: tuple[ApiKey, ...], loopback: bool
) -> None:
    warn_if_open(Authenticator(keys), "a host", loopback=loopback)
    assert not caplog.records
    warn_if_open(Authenticator(), "a host", loopback=False)
    assert len(caplog.records) == 1
