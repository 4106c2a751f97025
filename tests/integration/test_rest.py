"""Single requests over real sockets."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import cv2
import fakes
import httpx
import numpy as np
import pytest

from lanestream.logs import flush_logs
from lanestream.protocol import LanesMessage, parse_server_message

Serve = Callable[..., str]


def detect(url: str, content: bytes | Iterator[bytes], **options: object) -> httpx.Response:
    return httpx.post(f"{url}/v1/detect", content=content, **options)


def problem(response: httpx.Response) -> tuple[int, str]:
    """Returns the status and code of an error response."""
    body = response.json()
    assert set(body) == {"code", "message", "hint", "request_id"}
    assert "\n" not in body["message"]
    return response.status_code, body["code"]


@pytest.mark.parametrize("kind", [".jpg", ".png", ".webp"])
def test_lanes_of_an_image(url: str, kind: str) -> None:
    response = detect(url, fakes.image_file(kind))
    lanes = parse_server_message(response.text)
    assert isinstance(lanes, LanesMessage)
    assert (lanes.seq, lanes.width, lanes.height, lanes.dropped) == (0, 320, 180, 0)
    assert [lane.position for lane in lanes.lanes] == [-1, 1]
    stages = lanes.timing_ms
    assert stages.total == pytest.approx(
        stages.decode + stages.propose + stages.queue + stages.infer + stages.fit + stages.track, abs=0.01
    )


def test_an_image_can_be_sent_as_a_form_file(url: str) -> None:
    response = httpx.post(f"{url}/v1/detect", files={"file": ("road.jpg", fakes.image_file())})
    assert response.json()["width"] == 320


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        ({"files": {"other": ("road.jpg", b"x")}}, 422),
        ({"data": {"file": "text"}}, 415),
        ({"content": b"x", "headers": {"content-type": "multipart/form-data"}}, 422),
        ({"content": b"x", "headers": {"content-type": "multipart/form-data; boundary=b"}}, 422),
        ({"files": {"file": ("road.jpg", b"x" * 300_000)}}, 413),
    ],
)
def test_a_form_without_a_valid_file_is_refused(url: str, sent: dict[str, object], status: int) -> None:
    assert problem(httpx.post(f"{url}/v1/detect", **sent))[0] == status


@pytest.mark.parametrize(
    ("accept", "kind"), [("image/png", b"\x89PNG"), ("image/*", b"\xff\xd8"), ("image/jpeg", b"\xff\xd8")]
)
def test_lanes_are_drawn_on_request(url: str, accept: str, kind: bytes) -> None:
    response = detect(url, fakes.image_file(), headers={"accept": accept})
    assert response.content.startswith(kind)
    picture = cv2.imdecode(np.frombuffer(response.content, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape == (180, 320, 3)
    assert picture.std(axis=2).max() > 10, "the lanes are colored, the image is gray"


def test_other_media_types_are_refused(url: str) -> None:
    for accept in ("text/html", "x" * 7_900):
        refused = detect(url, fakes.image_file(), headers={"accept": accept})
        assert problem(refused) == (406, "not_acceptable")
        assert len(refused.text) < 400


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"", (415, "bad_image")),
        (b"hello, is this a road?", (415, "bad_image")),
        (fakes.image_file()[:-100], (415, "bad_image")),
        (fakes.image_file(".png", 1, 1), (415, "bad_image")),
        (fakes.image_file(".png", 8000, 1200, 0), (413, "image_too_large")),
        (bytes(300_000), (413, "image_too_large")),
    ],
)
def test_invalid_images_are_refused_with_a_reason(url: str, data: bytes, expected: tuple[int, str]) -> None:
    assert problem(detect(url, data)) == expected


def test_a_body_of_unknown_length_is_not_read_beyond_the_limit(url: str) -> None:
    def endless() -> Iterator[bytes]:
        while True:
            yield bytes(50_000)

    # The service responds and closes the connection; the response may be lost while the client is still sending.
    with suppress(httpx.WriteError, httpx.ReadError, httpx.RemoteProtocolError):
        assert problem(detect(url, endless())) == (413, "image_too_large")


@pytest.mark.parametrize("horizon", ["1", "-0.61", "nan", "x"])
def test_a_horizon_outside_its_range_is_refused(url: str, horizon: str) -> None:
    assert problem(detect(url, fakes.image_file(), params={"horizon": horizon})) == (422, "bad_message")


@pytest.mark.parametrize("share", [0.25, 0.0, -0.2, -0.6])
def test_a_horizon_is_used(url: str, share: float) -> None:
    response = detect(url, fakes.image_file(), params={"horizon": str(share)})
    assert response.json()["horizon"] == pytest.approx(180.0 * share, abs=0.5), "half a pixel of a resized image"


@pytest.mark.parametrize(("query", "positions"), [("", [-1, 1]), ("candidates", [-1, 1]), ("regression", [-1])])
def test_the_requested_detector_is_used(both_url: str, query: str, positions: list[int]) -> None:
    response = detect(both_url, fakes.image_file(), params={"detector": query} if query else None)
    assert [lane["position"] for lane in response.json()["lanes"]] == positions


def test_a_detector_that_is_not_loaded_is_refused(url: str) -> None:
    absent = detect(url, fakes.image_file(), params={"detector": "regression"})
    assert problem(absent) == (422, "no_detector")
    assert absent.json()["hint"] == "ask for candidates"
    unknown = detect(url, fakes.image_file(), params={"detector": "guesses"})
    assert problem(unknown) == (422, "bad_message")
    assert "'candidates' or 'regression'" in unknown.json()["message"]


@pytest.mark.parametrize(
    ("query", "name"),
    [
        ("horizn=0.3", "'horizn'"),
        ("Horizon=0.3", "'Horizon'"),
        ("horizon=0.3&kind=marking", "'kind'"),
        ("camera_height=1.4&fov=60", "'fov'"),
        ("=1", "''"),
        ("kinds[]=marking", "'kinds[]'"),
        ("a%0Ab=1", r"'a\nb'"),
        (300 * "x" + "=1", "'" + 79 * "x"),
    ],
)
def test_an_unknown_query_field_is_refused(url: str, query: str, name: str) -> None:
    response = httpx.post(f"{url}/v1/detect?{query}", content=fakes.image_file())
    assert problem(response) == (422, "bad_message")
    assert response.json()["message"] == f"unknown query field {name}"
    hint = "camera_height, field_of_view, camera, horizon, detector, kinds are accepted"
    assert sorted(response.json()["hint"].replace(" ", ",").split(",")) == sorted(hint.replace(" ", ",").split(","))


def test_a_request_without_query_fields_accepts_none(url: str) -> None:
    response = httpx.get(f"{url}/v1/models?detector=candidates")
    assert (response.status_code, response.json()["hint"]) == (422, "none is accepted here")
    assert httpx.get(f"{url}/v1/models").status_code == 200
    assert httpx.get(f"{url}/healthz?from=balancer").status_code == 200


def test_unexpected_errors_reveal_no_details(url: str, capfd: pytest.CaptureFixture[str]) -> None:
    response = detect(url, fakes.image_file(shade=255))
    assert problem(response) == (500, "internal")
    assert "mistake" not in response.text
    request = response.headers["X-Request-ID"]
    assert response.json()["request_id"] == request
    # One of the response and one of its cause, which is logged after the response was sent.
    lines: list[str] = []
    deadline = time.monotonic() + fakes.WAIT_S
    while len(lines) < 2:
        assert time.monotonic() < deadline
        flush_logs()
        lines += [line for line in capfd.readouterr().err.splitlines() if line.endswith(f"request_id={request}")]
    assert "Exception in ASGI application" in "".join(lines)


def test_unknown_paths_and_methods_are_refused_with_a_problem(url: str) -> None:
    assert problem(httpx.get(f"{url}/nothing")) == (404, "not_found")
    long = httpx.get(f"{url}/no%0athing/{'x' * 5000}")
    assert problem(long) == (404, "not_found")
    assert len(long.text) < 400
    refused = httpx.get(f"{url}/v1/detect")
    assert problem(refused) == (405, "method_not_allowed")
    assert refused.headers["allow"] == "POST"


def test_the_loaded_network_is_reported(url: str) -> None:
    network = {"name": "fake 1", "detector": "candidates", "provider": "cpu"}
    assert httpx.get(f"{url}/v1/models").json() == {
        "models": [{**network, "sha256": "fa4e", "metadata": {"kind": "fake"}}]
    }
    assert httpx.get(f"{url}/healthz").json() == {"status": "alive"}
    assert httpx.get(f"{url}/readyz").json() == {
        "status": "ready",
        "provider": "cpu",
        "networks": [network],
        "store": "memory",
        "store_reachable": True,
    }


def test_all_networks_are_reported_the_default_first(both_url: str) -> None:
    models = httpx.get(f"{both_url}/v1/models").json()["models"]
    ready = httpx.get(f"{both_url}/readyz").json()["networks"]
    for entries in (models, ready):
        assert [(entry["detector"], entry["name"]) for entry in entries] == [
            ("candidates", "fake 1"),
            ("regression", "other 2"),
        ]
    assert models[1]["metadata"] == {"kind": "other fake"}


def test_schemas_and_documentation_are_available(url: str) -> None:
    schemas = httpx.get(f"{url}/v1/schema").json()
    assert "LanesMessage" in schemas["server"]["$defs"]
    detectors = schemas["client"]["$defs"]["StartMessage"]["properties"]["detector"]["anyOf"]
    assert {"enum": ["candidates", "regression"], "type": "string"} in detectors
    content = httpx.get(f"{url}/openapi.json").json()["paths"]["/v1/detect"]["post"]["requestBody"]["content"]
    assert {"image/jpeg", "multipart/form-data"} <= set(content)


def test_single_images_count_as_sessions(serve: Serve) -> None:
    network = fakes.GatedModel()
    url = serve(fakes.engine(network), max_sessions=1)
    with ThreadPoolExecutor(1) as executor:
        first = executor.submit(detect, url, fakes.image_file())
        network.wait_for_a_frame()
        refused = detect(url, fakes.image_file())
        network.let_through(1)
        assert problem(refused) == (503, "busy")
        assert first.result().status_code == 200
