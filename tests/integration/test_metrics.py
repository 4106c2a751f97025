"""What Prometheus is told, by requests over real sockets."""

from __future__ import annotations

from collections.abc import Callable

import fakes
import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

Serve = Callable[..., str]
Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


def samples(url: str, **headers: str) -> Samples:
    """Every sample of the service, by its name and its labels."""
    response = httpx.get(f"{url}/metrics", headers=headers)
    assert response.status_code == 200
    assert response.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(response.text)
        for sample in family.samples
    }


def value(found: Samples, name: str, **labels: str) -> float:
    return found[name, frozenset(labels.items())]


def test_an_image_is_counted_and_timed(serve: Serve) -> None:
    url = serve(fakes.engine())
    assert value(samples(url), "lane_frames_received_total") == 0
    assert httpx.post(f"{url}/v1/detect", content=fakes.image_file()).status_code == 200
    found = samples(url)
    assert value(found, "lane_frames_received_total") == 1
    assert value(found, "lane_frames_processed_total") == 1
    assert value(found, "lane_frame_age_seconds_count") == 1
    stages = ("decode", "propose", "queue", "infer", "track")
    assert [value(found, "lane_stage_seconds_count", stage=stage) for stage in stages] == [1.0] * 5
    assert value(found, "lane_frame_age_seconds_sum") >= value(found, "lane_stage_seconds_sum", stage="decode") > 0.0
    assert value(found, "lane_batch_size_count", network="fake 1") == 1
    assert value(found, "lane_batch_size_sum", network="fake 1") == 2
    assert value(found, "lane_batch_wait_seconds_count", network="fake 1") == 1
    assert value(found, "lane_queue_depth") == 0


@pytest.mark.parametrize(
    ("data", "reason", "code"),
    [
        (b"no image", "decode_error", "bad_image"),
        (fakes.image_file(".png", 8000, 1200, 0), "too_large", "image_too_large"),
        (fakes.image_file(shade=255), "error", "internal"),
    ],
)
def test_a_refused_image_is_counted_with_the_reason(serve: Serve, data: bytes, reason: str, code: str) -> None:
    url = serve(fakes.engine())
    httpx.post(f"{url}/v1/detect", content=data)
    found = samples(url)
    assert value(found, "lane_frames_received_total") == 1
    assert value(found, "lane_frames_processed_total") == 0
    dropped = {dict(labels)["reason"]: count for (name, labels), count in found.items() if "dropped_total" in name}
    assert {name for name, count in dropped.items() if count} == {reason}
    assert value(found, "lane_refusals_total", code=code) == 1


def test_what_runs_is_told_once_it_is_loaded(serve: Serve) -> None:
    name, labels = "lane_inference_provider_info", {"provider": "cpu", "device": "cpu", "precision": "unknown"}
    assert all(name != sample for sample, _ in samples(serve()))
    found = samples(serve(fakes.two_detectors()))
    assert [value(found, name, network=network, **labels) for network in ("fake 1", "other 2")] == [1.0, 1.0]


def test_services_of_one_process_count_apart(serve: Serve) -> None:
    one, other = serve(fakes.engine()), serve(fakes.engine())
    httpx.post(f"{one}/v1/detect", content=fakes.image_file())
    assert [value(samples(url), "lane_frames_received_total") for url in (one, other)] == [1.0, 0.0]


def test_the_process_is_told_too(url: str) -> None:
    assert value(samples(url), "process_resident_memory_bytes") > 1e6
