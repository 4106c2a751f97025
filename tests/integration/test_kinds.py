"""Kinds of boundaries over real sockets: what they are, and which of them are reported."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import fakes
import httpx
import pytest
from wsclient import receive, send_message, stream

from lanestream import cli
from lanestream.errors import ProtocolError
from lanestream.local import LocalEngine
from lanestream.protocol import BoundaryKind, LanesMessage
from lanestream_client import AsyncLaneClient, LaneClient, SourceFrame
from lanestream_client.in_process import InProcessClient

Serve = Callable[..., str]

# Of the boundaries of the fake road, by the kinds that are asked for: their kinds and positions.
REPORTED: list[tuple[list[BoundaryKind], list[tuple[str, int]]]] = [
    (["marking"], [("marking", -1)]),
    (["road_edge"], [("road_edge", 1)]),
    (["road_edge", "marking"], [("marking", -1), ("road_edge", 1)]),
]


@pytest.fixture
def kinds_url(serve: Serve) -> str:
    """Returns the URL of a service that sees a dashed yellow marking on the left and a road edge on the right."""
    return serve(fakes.kinds_engine())


def found(lanes: dict[str, Any]) -> list[tuple[str, int]]:
    return [(lane["kind"], lane["position"]) for lane in lanes["lanes"]]


def frames(number: int = 5) -> Iterator[SourceFrame]:
    for seq in range(number):
        yield SourceFrame(seq, timestamp=0.04 * seq, data=fakes.image_file())


def test_a_stream_reports_what_boundaries_are(kinds_url: str) -> None:
    with stream(kinds_url) as socket:
        for _ in range(5):
            socket.send(fakes.image_file())
            lanes = receive(socket)
    left, right = lanes["lanes"]
    assert (left["kind"], right["kind"]) == ("marking", "road_edge")
    assert left["kind_probability"] > 0.9
    assert right["kind_probability"] > 0.9
    marking = left["marking"]
    assert (marking["type"], marking["color"]) == ("dashed", "yellow")
    assert 0.8 < marking["probability"] <= min(marking["type_probability"], marking["color_probability"])
    assert right["marking"] is None
    assert (lanes["ego"]["left_kind"], lanes["ego"]["right_kind"]) == ("marking", "road_edge")
    assert lanes["ego"]["offset"] is not None


@pytest.mark.parametrize(("kinds", "reported"), REPORTED)
def test_start_chooses_the_kinds(kinds_url: str, kinds: list[str], reported: list[tuple[str, int]]) -> None:
    with stream(kinds_url) as socket:
        send_message(socket, "start", kinds=kinds)
        assert receive(socket)["type"] == "ready"
        socket.send(fakes.image_file())
        lanes = receive(socket)
    assert found(lanes) == reported
    sides = {position: lane["track_id"] for lane in lanes["lanes"] for position in [lane["position"]]}
    assert (lanes["ego"]["left"], lanes["ego"]["right"]) == (sides.get(-1), sides.get(1))
    assert (lanes["ego"]["offset"] is None) == (len(reported) < 2)


@pytest.mark.parametrize("kinds", [[], ["curb"], ["marking", 3], "marking"])
def test_start_refuses_other_kinds(kinds_url: str, kinds: object) -> None:
    with stream(kinds_url) as socket:
        send_message(socket, "start", kinds=kinds)
        error = receive(socket)
    assert (error["type"], error["code"]) == ("error", "bad_message")
    assert "kinds" in error["message"]
    assert "\n" not in error["message"]


@pytest.mark.parametrize(("kinds", "reported"), REPORTED)
def test_an_image_is_answered_with_the_kinds_asked_for(
    kinds_url: str, kinds: list[str], reported: list[tuple[str, int]]
) -> None:
    response = httpx.post(f"{kinds_url}/v1/detect", content=fakes.image_file(), params={"kinds": kinds})
    assert found(response.json()) == reported


@pytest.mark.parametrize("query", ["kinds=", "kinds=curb", "kinds=marking&kinds=x", "kinds=marking,road_edge"])
def test_other_kinds_of_an_image_are_refused(kinds_url: str, query: str) -> None:
    response = httpx.post(f"{kinds_url}/v1/detect?{query}", content=fakes.image_file())
    assert (response.status_code, response.json()["code"]) == (422, "bad_message")
    assert "kinds" in response.json()["message"]
    assert "\n" not in response.json()["message"]


def test_openapi_documents_the_kinds(kinds_url: str) -> None:
    parameters = httpx.get(f"{kinds_url}/openapi.json").json()["paths"]["/v1/detect"]["post"]["parameters"]
    (kinds,) = [parameter for parameter in parameters if parameter["name"] == "kinds"]
    assert set(get_args(BoundaryKind)) == {
        name for option in kinds["schema"]["anyOf"] for name in option.get("items", {}).get("enum", ())
    }


def test_a_setting_is_the_default(serve: Serve) -> None:
    url = serve(fakes.kinds_engine(), kinds="road_edge")
    with LaneClient(url) as client:
        assert [lane.kind for lane in client.detect(fakes.image_file()).lanes] == ["road_edge"]
        assert [lane.kind for lane in client.detect(fakes.image_file(), kinds=["marking"]).lanes] == ["marking"]
        (result, *_) = client.stream(frames(), mode="all")
        assert result.lanes is not None
        assert [lane.kind for lane in result.lanes.lanes] == ["road_edge"]


@pytest.mark.parametrize(("kinds", "reported"), REPORTED)
async def test_the_clients_choose_kinds(
    kinds_url: str, kinds: list[BoundaryKind], reported: list[tuple[str, int]]
) -> None:
    results: list[LanesMessage | None] = []
    with LaneClient(kinds_url) as client:
        results += [client.detect(fakes.image_file(), kinds=kinds)]
        results += [result.lanes for result in client.stream(frames(), mode="all", kinds=kinds)]
    async with AsyncLaneClient(kinds_url) as async_client:
        results += [await async_client.detect(fakes.image_file(), kinds=kinds)]
        results += [result.lanes async for result in async_client.stream(frames(), mode="all", kinds=kinds)]
    local = InProcessClient(LocalEngine(fakes.kinds_engine()))
    results += [local.detect(fakes.image_file(), kinds=kinds)]
    results += [result.lanes for result in local.stream(frames(), kinds=kinds)]
    assert len(results) == 18
    for lanes in results:
        assert lanes is not None
        assert [(lane.kind, lane.position) for lane in lanes.lanes] == reported


def test_clients_refuse_to_report_nothing(kinds_url: str) -> None:
    local = InProcessClient(LocalEngine(fakes.kinds_engine()))
    with LaneClient(kinds_url) as client:
        for service in (client, local):
            with pytest.raises(ProtocolError, match="kind"):
                service.detect(fakes.image_file(), kinds=[])
            with pytest.raises(ProtocolError, match="kind"):
                service.stream(frames(), kinds=[])


@pytest.mark.parametrize("with_service", [False, True])
def test_the_commands_choose_kinds(
    serve: Serve,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    with_service: bool,
) -> None:
    (tmp_path / "frames").mkdir()
    for number in range(3):
        (tmp_path / "frames" / f"{number}.jpg").write_bytes(fakes.image_file())
    monkeypatch.setattr(LocalEngine, "load", lambda *_: LocalEngine(fakes.kinds_engine()))
    where = ["--url", serve(fakes.kinds_engine())] if with_service else []

    def run(command: str, *options: str) -> list[list[str]]:
        arguments = [command, str(tmp_path / "frames"), "--jsonl", "-", *where, *options]
        monkeypatch.setattr(sys, "argv", ["lanestream", *arguments])
        with pytest.raises(SystemExit) as caught:
            cli.main()
        output, _ = capsys.readouterr()
        assert caught.value.code in (0, None)
        return [[lane["kind"] for lane in json.loads(line)["lanes"]] for line in output.splitlines()]

    for command in ("detect", "stream"):
        assert run(command) == [["marking", "road_edge"]] * 3
        assert run(command, "--kinds", "road_edge") == [["road_edge"]] * 3
        assert run(command, "--kinds", "road_edge", "--kinds", "marking") == [["marking", "road_edge"]] * 3
