"""Lanes in meters through each interface of the service. The fake road is straight and the camera is centered."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fakes
import httpx
import pytest
from websockets.sync.client import connect

from lanestream import cli
from lanestream.local import LocalEngine
from lanestream.protocol import LanesMessage
from lanestream_client import AsyncLaneClient, CameraModel, LaneClient
from lanestream_client.in_process import InProcessClient

Serve = Callable[..., str]

CAMERA = CameraModel(height=1.4, field_of_view=62.0)
# The fake road's horizon is at 0.4 of the 180 rows, which is a pitch of 4.3 degrees for this lens.
FULL = CameraModel(
    height=1.4, focal_length=(532.6, 532.6), principal_point=(319.5, 179.5), image_size=(640, 360), lateral=0.2
)
# Frames after which the boundaries of a new stream are reported.
_CONFIRMED = 4
OPTIONS = ["--camera-height", "1.4", "--field-of-view", "62"]


def check_meters(lanes: LanesMessage | dict[str, Any] | None) -> None:
    """Checks the fake boundaries: 1.15 columns per row in the image, so 1.15 camera heights to each side.

    The camera looks down by 3.8 degrees, so its rows are that much denser.
    """
    assert lanes is not None
    message = lanes if isinstance(lanes, LanesMessage) else LanesMessage.model_validate(lanes)
    left, right = (lane.ground for lane in message.lanes)
    assert left == pytest.approx((0.0, 0.0, 1.6135), abs=1e-3)
    assert right == pytest.approx((0.0, 0.0, -1.6135), abs=1e-3)
    ego = message.ego
    assert ego.offset_m is not None
    assert (ego.offset_m, ego.lane_width_m) == pytest.approx((0.0, 3.227), abs=2e-3)
    assert (ego.heading, ego.curvature) == pytest.approx((0.0, 0.0), abs=1e-4)


def detect(url: str, **query: object) -> httpx.Response:
    return httpx.post(f"{url}/v1/detect", content=fakes.image_file(), params=query)


def test_a_stream_with_a_camera_has_lanes_in_meters(url: str) -> None:
    with connect(f"{url.replace('http', 'ws')}/v1/stream", compression=None) as socket:

        def receive() -> dict[str, Any]:
            message: dict[str, Any] = json.loads(socket.recv(fakes.WAIT_S))
            return message

        socket.send(json.dumps({"type": "start", "camera": {"height": 14, "field_of_view": 62}}))
        refused = receive()
        assert (refused["code"], refused["fatal"]) == ("bad_message", False)
        assert "camera.height" in refused["message"]
        assert "\n" not in refused["message"]
        socket.send(json.dumps({"type": "start", "mode": "all", "camera": {"height": 1.4, "field_of_view": 62}}))
        assert receive()["type"] == "ready"
        for _ in range(_CONFIRMED):
            socket.send(fakes.image_file())
            answer = receive()
        check_meters(answer)


def check_full_camera(lanes: LanesMessage | dict[str, Any] | None) -> None:
    """Checks the meters of the camera FULL, which is 0.2 m left of the vehicle's middle."""
    assert lanes is not None
    message = lanes if isinstance(lanes, LanesMessage) else LanesMessage.model_validate(lanes)
    assert message.ego.offset_m == pytest.approx(0.2, abs=5e-3)
    assert message.ego.lane_width_m == pytest.approx(3.22, abs=0.02)
    assert message.ego.heading == pytest.approx(0.0, abs=1e-3)


def test_a_camera_may_have_all_its_fields(url: str) -> None:
    check_full_camera(detect(url, camera=FULL.model_dump_json()).json())
    with connect(f"{url.replace('http', 'ws')}/v1/stream", compression=None) as socket:
        socket.send(json.dumps({"type": "start", "mode": "all", "camera": FULL.model_dump(exclude_defaults=True)}))
        socket.recv(fakes.WAIT_S)
        for _ in range(_CONFIRMED):
            socket.send(fakes.image_file())
            answer = json.loads(socket.recv(fakes.WAIT_S))
        check_full_camera(answer)


def test_a_horizon_and_a_pitch_contradict_each_other(url: str) -> None:
    pitched = CAMERA.model_copy(update={"pitch": 2.0})
    response = detect(url, camera=pitched.model_dump_json(), horizon=0.4)
    assert (response.status_code, response.json()["code"]) == (422, "bad_message")
    assert response.json()["message"] == "the horizon and the camera's pitch are both given"
    with connect(f"{url.replace('http', 'ws')}/v1/stream", compression=None) as socket:
        socket.send(json.dumps({"type": "start", "horizon": 0.4, "camera": pitched.model_dump(exclude_defaults=True)}))
        refused = json.loads(socket.recv(fakes.WAIT_S))
        assert (refused["code"], refused["fatal"]) == ("bad_message", False)
        socket.send(json.dumps({"type": "start", "mode": "all", "horizon": 0.4}))
        assert json.loads(socket.recv(fakes.WAIT_S))["type"] == "ready"


def test_a_camera_file_of_the_service_is_its_default(serve: Serve, tmp_path: Path) -> None:
    file = tmp_path / "camera.json"
    file.write_text(FULL.model_copy(update={"pitch": 4.3}).model_dump_json(exclude_defaults=True))
    url = serve(fakes.engine(), camera=file)
    check_full_camera(detect(url).json())
    check_full_camera(detect(url, horizon=0.4).json())
    check_meters(detect(url, camera_height=1.4, field_of_view=62).json())
    with LaneClient(url) as client:
        *_, last = client.stream([fakes.image_file()] * _CONFIRMED, mode="all")
        check_full_camera(last.lanes)


def test_a_camera_given_twice_is_refused(url: str) -> None:
    response = detect(url, camera=CAMERA.model_dump_json(), camera_height=1.4)
    assert (response.status_code, response.json()["message"]) == (422, "the camera is given twice")
    assert detect(url, camera="x" * 3000).status_code == 422


def test_a_single_image_with_a_camera_has_lanes_in_meters(url: str) -> None:
    check_meters(detect(url, camera_height=1.4, field_of_view=62).json())
    without = detect(url).json()
    assert [lane["ground"] for lane in without["lanes"]] == [None, None]
    assert [without["ego"][name] for name in ("offset_m", "lane_width_m", "heading", "curvature")] == [None] * 4


@pytest.mark.parametrize("query", [{"camera_height": 1.4}, {"field_of_view": 62}])
def test_an_incomplete_camera_is_refused(url: str, query: dict[str, float]) -> None:
    response = detect(url, **query)
    assert (response.status_code, response.json()["code"]) == (422, "bad_message")
    missing = "height: " if "field_of_view" in query else "give either field_of_view or focal_length"
    assert response.json()["message"].startswith(f"not a valid camera: {missing}")
    assert response.json()["hint"].startswith("give both the height")


@pytest.mark.parametrize(
    ("height", "field_of_view", "parameter"),
    [("0.2", "62", "camera_height"), ("nan", "62", "camera_height"), ("1.4", "180", "field_of_view")],
)
def test_an_invalid_camera_is_refused(url: str, height: str, field_of_view: str, parameter: str) -> None:
    response = detect(url, camera_height=height, field_of_view=field_of_view)
    assert (response.status_code, response.json()["code"]) == (422, "bad_message")
    assert parameter in response.json()["message"]
    assert "\n" not in response.json()["message"]


def test_openapi_documents_the_camera_parameters(url: str) -> None:
    parameters = httpx.get(f"{url}/openapi.json").json()["paths"]["/v1/detect"]["post"]["parameters"]
    (height,) = (parameter for parameter in parameters if parameter["name"] == "camera_height")
    assert not height["required"]
    assert {"minimum": 0.3, "maximum": 4.0, "type": "number"}.items() <= height["schema"]["anyOf"][0].items()
    assert "field_of_view" in {parameter["name"] for parameter in parameters}


async def test_the_clients_take_a_camera(url: str) -> None:
    image = fakes.image_file()
    for client in (LaneClient(url), InProcessClient(LocalEngine(fakes.engine()))):
        check_meters(client.detect(image, camera=CAMERA))
        *_, last = client.stream([image] * _CONFIRMED, mode="all", camera=CAMERA)
        check_meters(last.lanes)
        assert client.detect(image).lanes[0].ground is None
        if isinstance(client, LaneClient):
            client.close()
    async with AsyncLaneClient(url) as async_client:
        check_meters(await async_client.detect(image, camera=CAMERA))
        *_, last = [result async for result in async_client.stream([image] * _CONFIRMED, mode="all", camera=CAMERA)]
        check_meters(last.lanes)


def lanestream(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["lanestream", *arguments])
    with pytest.raises(SystemExit) as caught:
        cli.main()
    return int(caught.value.code or 0)


@pytest.mark.parametrize("remote", [False, True])
def test_the_commands_take_a_camera_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, url: str, remote: bool
) -> None:
    monkeypatch.setattr(LocalEngine, "load", lambda *_: LocalEngine(fakes.engine()))
    (tmp_path / "road.jpg").write_bytes(fakes.image_file())
    (tmp_path / "camera.json").write_text(FULL.model_dump_json(exclude_defaults=True))
    results = tmp_path / "lanes.jsonl"
    options = ["--jsonl", str(results), "--camera", str(tmp_path / "camera.json"), *(["--url", url] if remote else [])]
    assert lanestream(monkeypatch, "detect", str(tmp_path / "road.jpg"), *options) == 0
    (line,) = (json.loads(line) for line in results.read_text().splitlines())
    del line["file"]
    check_full_camera(line)


@pytest.mark.parametrize("remote", [False, True])
@pytest.mark.parametrize("command", ["detect", "stream"])
def test_the_commands_take_a_camera(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, url: str, command: str, remote: bool
) -> None:
    monkeypatch.setattr(LocalEngine, "load", lambda *_: LocalEngine(fakes.engine()))
    frames = tmp_path / "frames"
    frames.mkdir()
    for number in range(_CONFIRMED):
        (frames / f"{number}.jpg").write_bytes(fakes.image_file())
    where = ["--url", url] if remote else []
    results = tmp_path / "lanes.jsonl"
    assert lanestream(monkeypatch, command, str(frames), "--jsonl", str(results), *OPTIONS, *where) == 0
    *_, line = (json.loads(line) for line in results.read_text().splitlines())
    del line["file"]
    assert line.pop("clock", None) == ("frame_rate" if command == "stream" else None)
    check_meters(line)


@pytest.mark.parametrize("command", ["detect", "stream"])
@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (OPTIONS[:2], 1, "error: not a valid camera: give either field_of_view or focal_length ("),
        (OPTIONS[2:], 1, "error: not a valid camera: height: "),
        ([*OPTIONS[:2], "--field-of-view", "nan"], 1, "error: not a valid camera: field_of_view: "),
        (["--camera-height", "9", *OPTIONS[2:]], 2, "Usage: "),
        (["--camera", "gone.json"], 1, "error: can't read gone.json: no such file or directory"),
        (["--camera", __file__], 1, f"error: {__file__}: not a valid camera: Invalid JSON"),
        (["--camera", "any.json", *OPTIONS], 2, "Usage: "),
    ],
)
def test_the_commands_refuse_an_invalid_camera(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
    options: list[str],
    code: int,
    message: str,
) -> None:
    assert lanestream(monkeypatch, command, __file__, *options) == code
    errors = capsys.readouterr().err
    assert errors.startswith(message)
    assert code == 2 or errors.count("\n") == 1
