"""Spans of frames, received by a real HTTP server from real services."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import fakes
import httpx
import processes
import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.proto.trace.v1.trace_pb2 import Span
from websockets.sync.client import connect

from lanestream.logs import flush_logs

Serve = Callable[..., str]
TRACE = "4bf92f3577b34da6a3ce929d0e0e4736"


class Collector:
    """Receives spans. If it `answers` is False, it keeps every request waiting."""

    def __init__(self, *, answers: bool = True) -> None:
        self.spans: list[Span] = []
        self.services: set[str] = set()
        self._answers = answers

    def receive(self, body: bytes) -> None:
        request = ExportTraceServiceRequest.FromString(body)
        for resource in request.resource_spans:
            attributes = {each.key: each.value.string_value for each in resource.resource.attributes}
            self.services.add(attributes["service.name"])
            self.spans += [span for scope in resource.scope_spans for span in scope.spans]

    @contextmanager
    def listening(self) -> Iterator[str]:
        """Yields the URL of the collector."""
        collector, released = self, threading.Event()

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                if not collector._answers:
                    released.wait(fakes.WAIT_S)
                    return
                collector.receive(body)
                self.send_response(200)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                """Logs nothing."""

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            released.set()
            server.shutdown()
            server.server_close()
            thread.join()

    def wait_for(self, count: int) -> list[Span]:
        """Returns the spans once there are `count` of them."""
        deadline = time.monotonic() + fakes.WAIT_S
        while len(self.spans) < count:
            assert time.monotonic() < deadline
            time.sleep(0.02)
        return self.spans


@pytest.fixture
def collector(monkeypatch: pytest.MonkeyPatch) -> Iterator[Collector]:
    collector = Collector()
    with collector.listening() as url:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", url)
        monkeypatch.setenv("OTEL_BSP_SCHEDULE_DELAY", "50")
        yield collector


def _attributes(span: Span) -> dict[str, Any]:
    values = {each.key: each.value for each in span.attributes}
    return {name: getattr(value, str(value.WhichOneof("value"))) for name, value in values.items()}


def test_each_frame_of_a_stream_has_a_span_with_its_stages(serve: Serve, collector: Collector) -> None:
    url = serve(fakes.engine())
    with connect(f"{url.replace('http', 'ws')}/v1/stream", compression=None) as socket:
        socket.send(json.dumps({"type": "start", "mode": "all"}))
        session = json.loads(socket.recv(fakes.WAIT_S))["session"]
        answers = []
        for image in (fakes.image_file(), b"no image"):
            socket.send(image)
            answers.append(json.loads(socket.recv(fakes.WAIT_S)))
    good, bad = sorted(collector.wait_for(2), key=lambda span: span.start_time_unix_nano)
    assert collector.services == {"lanestream"}
    attributes = _attributes(good)
    assert {name: attributes[f"lanestream.{name}"] for name in ("session", "seq", "caller")} == {
        "session": session,
        "seq": 0,
        "caller": "anonymous",
    }
    stages = {name.removeprefix("lanestream.stage.").removesuffix("_ms") for name in attributes if "stage" in name}
    assert stages == set(answers[0]["timing_ms"])
    duration_ms = 1e-6 * (good.end_time_unix_nano - good.start_time_unix_nano)
    assert duration_ms >= attributes["lanestream.stage.total_ms"] > 0.0
    assert (_attributes(bad)["error.type"], bad.status.code) == ("bad_image", bad.status.STATUS_CODE_ERROR)


def test_an_image_belongs_to_the_trace_of_its_request(
    serve: Serve, collector: Collector, capfd: pytest.CaptureFixture[str]
) -> None:
    headers = {"traceparent": f"00-{TRACE}-00f067aa0ba902b7-01"}
    response = httpx.post(f"{serve(fakes.engine())}/v1/detect", content=fakes.image_file(), headers=headers)
    assert response.status_code == 200
    (span,) = collector.wait_for(1)
    assert (span.trace_id.hex(), span.parent_span_id.hex()) == (TRACE, "00f067aa0ba902b7")
    request = response.headers["X-Request-ID"]
    assert _attributes(span)["lanestream.request_id"] == request
    flush_logs()
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "/v1/detect" in line]
    assert line.endswith(f" request_id={request} trace_id={TRACE}")


def test_records_about_a_frame_name_its_trace(
    serve: Serve, collector: Collector, capfd: pytest.CaptureFixture[str]
) -> None:
    url = serve(fakes.engine())
    with connect(f"{url.replace('http', 'ws')}/v1/stream", compression=None) as socket:
        socket.send(fakes.image_file(shade=255))
        assert json.loads(socket.recv(fakes.WAIT_S))["code"] == "internal"
        assert socket.response is not None
        request = socket.response.headers["X-Request-ID"]
    (span,) = collector.wait_for(1)
    assert _attributes(span)["lanestream.request_id"] == request
    flush_logs()
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "frame failed" in line]
    assert line.endswith(f" seq=0 request_id={request} trace_id={span.trace_id.hex()}")


def test_a_sampler_chooses_the_frames(serve: Serve, collector: Collector, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_TRACES_SAMPLER", "parentbased_always_off")
    url = serve(fakes.engine())
    for flag in ("00", "01"):
        headers = {"traceparent": f"00-{TRACE}-00f067aa0ba902b7-{flag}"}
        assert httpx.post(f"{url}/v1/detect", content=fakes.image_file(), headers=headers).status_code == 200
    collector.wait_for(1)
    time.sleep(0.2)
    assert len(collector.spans) == 1


def test_a_collector_that_does_not_answer_delays_neither_frames_nor_the_end(
    serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_TIMEOUT", "600")
    with Collector(answers=False).listening() as endpoint:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", endpoint)
        with processes.service(processes=0) as (process, url):
            for _ in range(3):
                assert httpx.post(f"{url}/v1/detect", content=fakes.image_file()).status_code == 200
            process.terminate()
            assert process.wait(fakes.WAIT_S) == -signal.SIGTERM
