"""Traces for OpenTelemetry: one span for each frame, with the duration of each stage.

OpenTelemetry's own variables configure it: where to send spans, the sampler, the name of the service. Without
`OTEL_EXPORTER_OTLP_ENDPOINT` nothing is traced and its packages are not imported.
"""

from __future__ import annotations

import asyncio
import logging
import os
import threading
import time
from importlib.metadata import version
from typing import TYPE_CHECKING, Final

from lanestream.errors import LanestreamError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from opentelemetry.sdk.trace import TracerProvider
_log = logging.getLogger(__name__)
_ENDPOINTS: Final = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
_NAME: Final = "lanestream"
# How long a stop waits until the last spans are sent.
_FLUSH_S: Final = 2.0
_FLUSH_POLL_S: Final = 0.02
_NANOSECONDS: Final = 1e9


class FrameTracer:
    """Makes a span for each frame that the sampler selects. Spans are sent in batches, by a thread of their own."""

    def __init__(self, provider: TracerProvider) -> None:
        # Imported here, since the packages are optional.
        from opentelemetry.trace import StatusCode
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

        self._provider = provider
        self._tracer = provider.get_tracer(_NAME, version(_NAME))
        self._failed = StatusCode.ERROR
        self._propagator = TraceContextTextMapPropagator()

    def record(
        self,
        arrived: float,
        attributes: Mapping[str, str | int],
        timing_ms: Mapping[str, float] | None = None,
        error: BaseException | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> str | None:
        """Makes the span of a frame that has been answered or has failed. Returns its trace id if it is sampled.

        The span begins when the frame `arrived`, in monotonic seconds, and ends now. `timing_ms` are the stages in
        milliseconds. `headers` may carry a W3C `traceparent`, whose span is the parent then.
        """
        now = time.time_ns()
        span = self._tracer.start_span(
            "frame",
            context=None if headers is None else self._propagator.extract(headers),
            start_time=now - int((time.monotonic() - arrived) * _NANOSECONDS),
            attributes={f"{_NAME}.{name}": value for name, value in attributes.items()},
        )
        sampled = span.is_recording()
        if sampled:
            for stage, duration in (timing_ms or {}).items():
                span.set_attribute(f"{_NAME}.stage.{stage}_ms", duration)
            if error is not None:
                code = error.code if isinstance(error, LanestreamError) else LanestreamError.code
                span.set_attribute("error.type", code)
                span.set_status(self._failed)
        span.end(now)
        return f"{span.get_span_context().trace_id:032x}" if sampled else None

    async def close(self) -> None:
        """Sends the spans that still wait, for at most two seconds."""
        # A daemon, since a collector that does not answer must not delay the end of the process.
        flushing = threading.Thread(target=self._provider.shutdown, daemon=True)
        flushing.start()
        deadline = time.monotonic() + _FLUSH_S
        while flushing.is_alive() and time.monotonic() < deadline:
            await asyncio.sleep(_FLUSH_POLL_S)


def open_tracer() -> FrameTracer | None:
    """Returns a tracer if a variable names a collector and the packages of OpenTelemetry are installed, else None."""
    if not any(os.environ.get(name) for name in _ENDPOINTS):
        return None
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import OTELResourceDetector, Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as error:
        _log.warning("frames are not traced: %s is not installed (pip install 'lanestream[tracing]')", error.name)
        return None
    defaults = {"service.name": _NAME, "service.version": version(_NAME)}
    provider = TracerProvider(
        resource=Resource(defaults).merge(OTELResourceDetector().detect()), shutdown_on_exit=False
    )
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    return FrameTracer(provider)
