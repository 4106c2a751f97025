"""Services with networks from model files: what they return is what the engine returns in process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
from processes import service

from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR, Engine, load_engine, resolve_regressor
from lanestream.errors import ModelError, NoDetectorError
from lanestream.images.decoding import ImageLimits, decode
from lanestream.inference.model_info import METADATA_KEY, RegressorInfo
from lanestream.local import LocalEngine
from lanestream.protocol import DetectorName, LanesMessage
from lanestream.road.crops import RoadCropGeometry
from lanestream_client import LaneClient, SourceFrame
from lanestream_client.in_process import InProcessClient
from lanestream_client.requests import ServiceInfo
from lanestream_exporter.scenes import Drive, render_clip, sample_clip

Serve = Callable[..., str]
FPS = 25.0


@pytest.fixture(scope="module")
def drive() -> list[bytes]:
    """Returns six frames of a rendered highway as PNG files, which lose nothing."""
    clip = sample_clip(np.random.default_rng(24), 640, 360, frames=6, fps=FPS, drive=Drive("highway", fair=True))
    return [cv2.imencode(".png", frame.image)[1].tobytes() for frame in render_clip(clip)]


# Both boundaries of a straight road, nearly certain and present, with the horizon where the crop assumed it.
OUTPUT = [-0.4, -0.16, -0.06, 0.4, 0.16, 0.06, *[0.01] * 6, 0.9, 0.9, 0.0]


@pytest.fixture(scope="module")
def regressor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the model file of a regressor that sees the same two boundaries in every image."""
    helper, size = onnx.helper, 32
    nodes = [
        helper.make_node("Shape", ["images"], ["count"], start=0, end=1),
        helper.make_node("Constant", [], ["one"], value_ints=[1]),
        helper.make_node("Concat", ["count", "one"], ["rows"], axis=0),
        helper.make_node("Constant", [], ["output"], value=helper.make_tensor("r", 1, [1, len(OUTPUT)], OUTPUT)),
        helper.make_node("Tile", ["output", "rows"], ["outputs"]),
    ]
    graph = helper.make_graph(
        nodes,
        "constant",
        [helper.make_tensor_value_info("images", onnx.TensorProto.UINT8, ["N", size, size, 3])],
        [helper.make_tensor_value_info("outputs", onnx.TensorProto.FLOAT, ["N", len(OUTPUT)])],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    info = RegressorInfo(
        name="constant",
        version="1",
        kind="regressor",
        threshold=0.5,
        precision="fp32",
        training={},
        metrics={},
        exporter="",
        road_crop=RoadCropGeometry(size=size, above=0.1, narrowest=0.5, detail_width=64),
    )
    helper.set_model_props(model, {METADATA_KEY: info.model_dump_json()})
    path = tmp_path_factory.mktemp("models") / "constant.onnx"
    onnx.save(model, str(path))
    return path


def without_timing(message: LanesMessage | None) -> dict[str, Any]:
    assert message is not None
    return message.model_dump(exclude={"timing_ms", "seq", "timestamp"})


def frames(files: list[bytes]) -> list[SourceFrame]:
    return [SourceFrame(seq, seq / FPS, data=data) for seq, data in enumerate(files)]


def test_both_ego_boundaries_are_tracked(real_url: str, drive: list[bytes]) -> None:
    with LaneClient(real_url) as client:
        results = [result.lanes for result in client.stream(frames(drive), mode="all")]
    egos = {(lanes.ego.left, lanes.ego.right) for lanes in results if lanes is not None}
    assert len(egos) == 1, "the track ids stay"
    (ego,) = egos
    assert None not in ego
    for lanes in results:
        assert lanes is not None
        for lane in lanes.lanes:
            for x, y in lane.points:
                assert lane.x(y) == pytest.approx(x, abs=0.01)


def test_a_stream_in_process_gives_the_same_lanes(real_url: str, real_engine: Engine, drive: list[bytes]) -> None:
    local = InProcessClient(LocalEngine(real_engine))
    with LaneClient(real_url) as client:
        remote = [without_timing(result.lanes) for result in client.stream(frames(drive), mode="all")]
        single = without_timing(client.detect(drive[0]))
    assert [without_timing(result.lanes) for result in local.stream(frames(drive))] == remote
    assert without_timing(local.detect(drive[0])) == single


@pytest.fixture(params=["cpu", "openvino", "processes"])
def service_url(request: pytest.FixtureRequest, serve: Serve) -> Iterator[str]:
    """Returns the URL of a service that processes frames in threads, with either runtime, or in processes."""
    if request.param == "processes":
        with service(processes=2) as (_, url):
            yield url
    else:
        yield serve(load_engine(None, request.param))


def test_parallel_streams_give_the_lanes_of_separate_ones(
    service_url: str, drive: list[bytes], request: pytest.FixtureRequest
) -> None:
    # They differ in where they begin and in their detector; their frames share batches.
    drives: list[tuple[list[bytes], DetectorName]] = [
        (drive, "candidates"),
        (drive[::-1], "candidates"),
        (drive[len(drive) // 2 :] * 2, "candidates"),
        (drive, "regression"),
    ]

    def run(one: tuple[list[bytes], DetectorName]) -> list[dict[str, Any]]:
        with LaneClient(service_url) as client:
            results = client.stream(frames(one[0]), mode="all", detector=one[1])
            return [without_timing(result.lanes) for result in results]

    separate = [run(one) for one in drives]
    with ThreadPoolExecutor(len(drives)) as pool:
        together = list(pool.map(run, drives))
    # OpenVINO's results for an input differ in the last digit by the batch that it is in.
    assert together == (nearly(separate) if "openvino" in request.node.name else separate)


def nearly(value: Any) -> Any:
    """Returns an answer that is equal to those whose numbers differ from its own only a little."""
    if isinstance(value, dict):
        return {key: nearly(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(nearly(each) for each in value)
    return pytest.approx(value, rel=1e-3, abs=0.02) if isinstance(value, float) else value


def test_a_regressor_next_to_the_classifier_is_a_second_detector(
    serve: Serve, drive: list[bytes], regressor: Path
) -> None:
    engine = load_engine(None, "cpu", regressor)
    local = InProcessClient(LocalEngine(engine))
    with LaneClient(serve(engine)) as client:
        assert client.describe("regression").model == "constant 1"
        assert client.describe().model == local.describe("candidates").model != "constant 1"
        results = list(client.stream(frames(drive), mode="all", detector="regression"))
        remote = [without_timing(result.lanes) for result in results]
        assert [without_timing(result.lanes) for result in local.stream(frames(drive), detector="regression")] == remote
        with_prior = client.detect(drive[0], detector="candidates")
    assert without_timing(local.detect(drive[0])) == without_timing(with_prior) != remote[0]
    for result in results:
        assert result.lanes is not None
        assert [lane.position for lane in result.lanes.lanes] == [-1, 1]
        columns = [(lane.points[0][0] - 319.5) / 640 for lane in result.lanes.lanes]
        assert columns == pytest.approx([-0.4, 0.4], abs=0.08)  # moved onto the paint near them


def test_a_regressor_as_the_model_is_the_only_detector(regressor: Path, drive: list[bytes]) -> None:
    local = InProcessClient(LocalEngine.load(regressor, "cpu"))
    assert local.describe() == local.describe("regression") == ServiceInfo("constant 1", "cpu")
    assert len(local.detect(drive[0]).lanes) == 2
    with pytest.raises(NoDetectorError, match="ask for regression"):
        local.detect(drive[0], detector="candidates")


def test_the_regressor_can_be_left_out(drive: list[bytes], regressor: Path) -> None:
    local = InProcessClient(LocalEngine.load(None, "cpu", Path("none")))
    assert len(local.detect(drive[0]).lanes) >= 2
    with pytest.raises(NoDetectorError, match="ask for candidates"):
        local.detect(drive[0], detector="regression")
    with pytest.raises(ModelError, match=r"is a classifier, not a regressor \(give one, or `none`\)"):
        LocalEngine.load(None, "cpu", SHIPPED_MODEL)
    assert (resolve_regressor(None), resolve_regressor(Path("none"))) == (SHIPPED_REGRESSOR, None)
    assert resolve_regressor(regressor) == regressor


def test_timestamps_may_jump(real_url: str, drive: list[bytes]) -> None:
    times = [0.0, -5.0, 1e15, -1e15, 0.0, 0.04]
    jumping = [SourceFrame(seq, times[seq], data=data) for seq, data in enumerate(drive)]
    with LaneClient(real_url) as client:
        results = list(client.stream(jumping, mode="all"))
    assert [result.lanes is not None and result.lanes.timestamp for result in results] == times
    assert all(result.lanes is not None and result.lanes.ego.left is not None for result in results)


def test_the_image_size_may_change_in_a_stream(real_url: str, drive: list[bytes]) -> None:
    image = decode(drive[0], ImageLimits())
    sizes = [(640, 360), (320, 180), (1920, 1080), (64, 64), (200, 1000), (640, 360)]
    files = [cv2.imencode(".jpg", cv2.resize(image, size))[1].tobytes() for size in sizes]
    with LaneClient(real_url) as client:
        results = [result.lanes for result in client.stream(files, mode="all")]
    assert [(lanes.width, lanes.height) for lanes in results if lanes is not None] == sizes
