"""The Prometheus metrics, by requests over real sockets."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import fakes
import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families
from wsclient import receive, receive_close, send_message, stream, wait_until_read, wait_until_released

from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR

Serve = Callable[..., str]
OPERATIONS = Path(__file__).parents[2] / "docs" / "operations.md"
Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


def samples(url: str, **headers: str) -> Samples:
    """Returns every sample of the service by name and labels."""
    response = httpx.get(f"{url}/metrics", headers=headers)
    assert response.status_code == 200
    assert response.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(response.text)
        for sample in family.samples
    }


def value(metrics: Samples, name: str, /, **labels: str) -> float:
    return metrics[name, frozenset(labels.items())]


def test_an_image_is_counted_and_timed(serve: Serve) -> None:
    url = serve(fakes.engine())
    assert value(samples(url), "lane_frames_received_total") == 0
    assert httpx.post(f"{url}/v1/detect", content=fakes.image_file()).status_code == 200
    metrics = samples(url)
    assert value(metrics, "lane_frames_received_total") == 1
    assert value(metrics, "lane_frames_processed_total") == 1
    assert value(metrics, "lane_frame_age_seconds_count") == 1
    stages = ("decode", "propose", "queue", "infer", "track")
    assert [value(metrics, "lane_stage_seconds_count", stage=stage) for stage in stages] == [1.0] * 5
    assert (
        value(metrics, "lane_frame_age_seconds_sum") >= value(metrics, "lane_stage_seconds_sum", stage="decode") > 0.0
    )
    assert value(metrics, "lane_batch_size_count", network="fake 1") == 1
    assert value(metrics, "lane_batch_size_sum", network="fake 1") == 2
    assert value(metrics, "lane_batch_wait_seconds_count", network="fake 1") == 1
    assert value(metrics, "lane_queue_depth") == 0


@pytest.mark.parametrize(
    ("data", "reason", "code"),
    [
        (b"no image", "decode_error", "bad_image"),
        (fakes.image_file(".png", 8000, 1200, 0), "too_large", "image_too_large"),
        (fakes.image_file(shade=255), "error", "internal"),
    ],
)
def test_a_refused_image_is_counted_with_its_reason(serve: Serve, data: bytes, reason: str, code: str) -> None:
    url = serve(fakes.engine())
    httpx.post(f"{url}/v1/detect", content=data)
    metrics = samples(url)
    assert value(metrics, "lane_frames_received_total") == 1
    assert value(metrics, "lane_frames_processed_total") == 0
    dropped = {dict(labels)["reason"]: count for (name, labels), count in metrics.items() if "dropped_total" in name}
    assert {name for name, count in dropped.items() if count} == {reason}
    assert value(metrics, "lane_refusals_total", code=code) == 1


def test_an_unknown_path_is_counted_as_a_refusal(serve: Serve) -> None:
    url = serve(fakes.engine())
    httpx.get(f"{url}/nothing")
    httpx.get(f"{url}/v1/detect")
    metrics = samples(url)
    assert value(metrics, "lane_refusals_total", code="not_found") == 1
    assert value(metrics, "lane_refusals_total", code="method_not_allowed") == 1


def test_networks_are_reported_once_they_are_loaded(serve: Serve) -> None:
    name, labels = "lane_inference_provider_info", {"provider": "cpu", "device": "cpu", "precision": "unknown"}
    assert all(name != sample for sample, _ in samples(serve()))
    metrics = samples(serve(fakes.two_detectors()))
    for network in ("fake 1", "other 2"):
        assert value(metrics, name, network=network, **labels) == 1
        assert value(metrics, "lane_provider_fallback", network=network) == 0
        assert value(metrics, "lane_model_info", name=network, version="unknown", sha256="fa4e") == 1


def test_a_provider_fallback_is_reported(serve: Serve) -> None:
    class FallbackModel(fakes.FakeModel):
        placement = replace(fakes.FakeModel.placement, fell_back=True)

    metrics = samples(serve(fakes.engine(FallbackModel())))
    assert value(metrics, "lane_provider_fallback", network="fake 1") == 1


def test_the_shipped_networks_are_reported_with_their_files(real_url: str) -> None:
    metrics = samples(real_url)
    models = {dict(labels)["name"]: dict(labels) for name, labels in metrics if name == "lane_model_info"}
    for path in (SHIPPED_MODEL, SHIPPED_REGRESSOR):
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        (model,) = [model for model in models.values() if model["sha256"] == digest]
        assert model["version"].count(".") == 2
    labels = {dict(labels)["precision"] for name, labels in metrics if name == "lane_inference_provider_info"}
    assert labels <= {"int8", "fp16", "fp32"}


def test_a_stream_is_counted_frame_by_frame(serve: Serve) -> None:
    network = fakes.GatedModel()
    url = serve(fakes.engine(network))
    with stream(url) as socket:
        socket.send(fakes.image_file())
        network.wait_for_a_frame()
        for _ in range(4):
            socket.send(fakes.image_file())
        wait_until_read(socket)
        metrics = samples(url)
        assert value(metrics, "lane_sessions_active") == 1
        assert value(metrics, "lane_frames_received_total") == 5
        assert value(metrics, "lane_frames_dropped_total", reason="superseded") == 3
        assert value(metrics, "lane_frames_processed_total") == 0
        network.let_through(2)
        assert [receive(socket)["type"] for _ in range(2)] == ["lanes", "lanes"]
        socket.send(b"no image")
        assert receive(socket)["code"] == "bad_image"
        send_message(socket, "end")
        assert receive(socket)["type"] == "summary"
        assert receive_close(socket)[0] == 1000
    wait_until_released(url)
    metrics = samples(url)
    assert value(metrics, "lane_frames_processed_total") == value(metrics, "lane_frame_age_seconds_count") == 2
    assert value(metrics, "lane_frames_dropped_total", reason="decode_error") == 1
    assert value(metrics, "lane_refusals_total", code="bad_message") == 1
    assert value(metrics, "lane_refusals_total", code="bad_image") == 1
    assert value(metrics, "lane_ws_closes_total", code="1000") == 1
    dropped = sum(count for (name, _), count in metrics.items() if name == "lane_frames_dropped_total")
    assert value(metrics, "lane_frames_received_total") == dropped + value(metrics, "lane_frames_processed_total")


def test_close_codes_of_clients_do_not_add_series(serve: Serve) -> None:
    url = serve(fakes.engine())
    for code in (1001, 3000, 3001, 4444, 4999):
        with stream(url) as socket:
            socket.close(code)
    closes = {
        dict(labels)["code"]: count for (name, labels), count in samples(url).items() if name == "lane_ws_closes_total"
    }
    assert closes == {"1001": 1, "other": 4}


def test_frames_of_a_disconnected_client_are_counted(serve: Serve) -> None:
    network = fakes.GatedModel()
    url = serve(fakes.engine(network))
    with stream(url, mode="all") as socket:
        for _ in range(3):
            socket.send(fakes.image_file())
        network.wait_for_a_frame()
        wait_until_read(socket)
    network.let_through(3)
    wait_until_released(url)
    metrics = samples(url)
    assert value(metrics, "lane_frames_received_total") == 3
    assert value(metrics, "lane_frames_dropped_total", reason="disconnected") == 3


def test_the_operations_page_has_every_metric(url: str) -> None:
    httpx.post(f"{url}/v1/detect", content=b"no image")
    families = text_string_to_metric_families(httpx.get(f"{url}/metrics").text)
    names = {
        f"{family.name}_total" if family.type == "counter" else family.name
        for family in families
        if family.name.startswith("lane_") and not family.name.endswith("_created")
    }
    assert names == set(re.findall(r"^\| `(lane_\w+)` \|", OPERATIONS.read_text(), re.MULTILINE))


def test_applications_in_one_process_have_separate_metrics(serve: Serve) -> None:
    one, other = serve(fakes.engine()), serve(fakes.engine())
    httpx.post(f"{one}/v1/detect", content=fakes.image_file())
    assert [value(samples(url), "lane_frames_received_total") for url in (one, other)] == [1.0, 0.0]


def test_process_metrics_are_included(url: str) -> None:
    assert value(samples(url), "process_resident_memory_bytes") > 1e6
