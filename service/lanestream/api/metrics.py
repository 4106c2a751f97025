"""Prometheus metrics of the service, in base units, with one registry per application."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Final, Literal, get_args

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Metric, PlatformCollector, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4, generate_latest
from prometheus_client.registry import Collector

from lanestream.api.connections import CUT_REASONS, CutReason
from lanestream.errors import (
    BusyError,
    DrainingError,
    ExpiredError,
    ImageError,
    ImageTooLargeError,
    LanestreamError,
    OverrunError,
    RateError,
)
from lanestream.protocol import WARNINGS
from lanestream.workers.pool import WorkerEvent

if TYPE_CHECKING:
    from lanestream.inference.batcher import BatchReport
    from lanestream.protocol import WarningCode
    from lanestream.workers.capabilities import DetectorInfo

DropReason = Literal["superseded", "expired", "overload", "decode_error", "too_large", "rate", "disconnected", "error"]
ResumeResult = Literal["resumed", "unknown", "refused"]

# The close codes that this service and ordinary clients send (RFC 6455, section 7.4.1); any other counts as `other`.
_CLOSE_CODES: Final = frozenset({*range(1000, 1004), *range(1005, 1015), 4001, 4002, 4003})

MEDIA_TYPE: Final = CONTENT_TYPE_PLAIN_0_0_4

# Why a received frame was not answered with lanes, by the code of its error. Any other code counts as `error`.
_DROP_REASONS: Final[Mapping[str, DropReason]] = {
    ImageError.code: "decode_error",
    ImageTooLargeError.code: "too_large",
    ExpiredError.code: "expired",
    RateError.code: "rate",
    OverrunError.code: "overload",
    BusyError.code: "overload",
    DrainingError.code: "overload",
}
_ON_GPU: Final = frozenset({"cuda", "tensorrt"})
# The sum of the stages in `timing_ms`; not a stage itself.
_TOTAL: Final = "total"

_STAGE_BUCKETS: Final = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128, 0.256, 0.512, 1.0, 2.0)
_AGE_BUCKETS: Final = (0.002, 0.005, 0.01, 0.015, 0.02, 0.025, 0.035, 0.05, 0.075, 0.1, 0.15, 0.25, 0.5, 1.0, 2.5, 5.0)
_BATCH_BUCKETS: Final = (1, 2, 4, 8, 16, 32, 64, 128)


class Metrics:
    """The metrics of one application. Its methods may be called from any thread."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        PlatformCollector(registry=self._registry)
        self._received = self._counter("lane_frames_received_total", "Frames received, streamed or single.")
        self._processed = self._counter("lane_frames_processed_total", "Frames answered with lanes.")
        self._dropped = self._counter(
            "lane_frames_dropped_total", "Frames received and not answered with lanes.", "reason"
        )
        self._refusals = self._counter("lane_refusals_total", "Errors sent to clients.", "code")
        self._timestamp_warnings = self._counter(
            "lane_timestamp_warnings_total", "Sessions whose frames had implausible timestamps.", "code"
        )
        self._resumed = self._counter("lane_sessions_resumed_total", "Attempts to resume a session.", "result")
        self._closes = self._counter("lane_ws_closes_total", "WebSockets closed, by close code.", "code")
        self._cuts = self._counter(
            "lane_connections_cut_total", "Connections closed before their peers were done, by reason.", "reason"
        )
        self._worker_events = self._counter(
            "lane_worker_events_total", "Worker processes that ended, hung, were replaced or did not start.", "event"
        )
        self._store_failures = self._counter(
            "lane_store_failures_total", "Operations of the session store that failed."
        )
        self._sessions = self._gauge("lane_sessions_active", "Streams with a session.")
        self._tasks = self._gauge("lane_tasks", "Tasks of the event loop.")
        self._connections = self._gauge("lane_connections", "TCP connections.")
        self._buffered = self._gauge("lane_buffered_bytes", "Received images and unsent pictures that are kept.")
        self._store_reachable = self._gauge(
            "lane_store_reachable", "1 if sessions can be saved: no operation of the session store failed lately."
        )
        self._certificate_expiry = self._gauge(
            "lane_certificate_expiry_timestamp_seconds", "When the certificate for https expires; NaN without one."
        )
        self._certificate_expiry.set(math.nan)
        self._log_drops = self._gauge("lane_log_records_dropped", "Log records that were dropped since the start.")
        self._queue = self._gauge("lane_queue_depth", "Inference requests still waiting when the last batch started.")
        self._provider = self._gauge(
            "lane_inference_provider_info",
            "The execution provider of a network.",
            "network",
            "provider",
            "device",
            "precision",
        )
        self._fallback = self._gauge(
            "lane_provider_fallback", "1 if a better provider is installed but can't be used.", "network"
        )
        self._model = self._gauge("lane_model_info", "The model file of a network.", "name", "version", "sha256")
        self._stages = self._histogram(
            "lane_stage_seconds", "Duration of the stages of an answered frame.", _STAGE_BUCKETS, "stage"
        )
        self._age = self._histogram(
            "lane_frame_age_seconds", "Time from a frame's arrival to its answer.", _AGE_BUCKETS
        )
        self._batch_size = self._histogram("lane_batch_size", "Inputs in a batch.", _BATCH_BUCKETS, "network")
        self._batch_wait = self._histogram(
            "lane_batch_wait_seconds",
            "How long the oldest inference request of a batch waited.",
            _STAGE_BUCKETS,
            "network",
        )
        # Start every label at 0: a rate over a missing series has no value.
        for reason in get_args(DropReason):
            self._dropped.labels(reason)
        for result in get_args(ResumeResult):
            self._resumed.labels(result)
        for cut in CUT_REASONS:
            self._cuts.labels(cut)
        for code in WARNINGS:
            self._timestamp_warnings.labels(code)
        for event in get_args(WorkerEvent):
            self._worker_events.labels(event)

    def frame_received(self) -> None:
        """Counts a received frame. `frame_processed`, `frame_dropped` or `frame_failed` follows for each."""
        self._received.inc()

    def frame_dropped(self, reason: DropReason) -> None:
        """Counts a received frame that gets no lanes."""
        self._dropped.labels(reason).inc()

    def frame_failed(self, error: BaseException) -> None:
        """Counts a received frame that gets no lanes because of `error`."""
        code = error.code if isinstance(error, LanestreamError) else LanestreamError.code
        self.frame_dropped(_DROP_REASONS.get(code, "error"))

    def frame_processed(self, timing_ms: Mapping[str, float], age_s: float) -> None:
        """Counts an answered frame: milliseconds of its stages, and seconds from its arrival to its reply."""
        self._processed.inc()
        self._age.observe(age_s)
        for stage, duration_ms in timing_ms.items():
            if stage != _TOTAL:
                self._stages.labels(stage).observe(1e-3 * duration_ms)

    def batch(self, report: BatchReport) -> None:
        """Counts a batch that a network has run."""
        self._batch_size.labels(report.model).observe(report.inputs)
        self._batch_wait.labels(report.model).observe(report.longest_wait_s)
        self._queue.set(report.still_waiting)

    def session_opened(self) -> None:
        """Counts a stream that opened or resumed a session."""
        self._sessions.inc()

    def session_closed(self) -> None:
        """Counts a stream whose session was closed."""
        self._sessions.dec()

    def sample(self, *, tasks: int, connections: int, buffered: int, store_reachable: bool, log_drops: int) -> None:
        """Sets what is measured when the metrics are read; `buffered` is in bytes."""
        self._tasks.set(tasks)
        self._connections.set(connections)
        self._buffered.set(buffered)
        self._store_reachable.set(store_reachable)
        self._log_drops.set(log_drops)

    def session_resumed(self, result: ResumeResult) -> None:
        """Counts a `start` with a resume token."""
        self._resumed.labels(result).inc()

    def socket_closed(self, code: int) -> None:
        """Counts a WebSocket closed with `code` by either side."""
        self._closes.labels(str(code) if code in _CLOSE_CODES else "other").inc()

    def connection_cut(self, reason: CutReason) -> None:
        """Counts a connection that was closed before its peer was done."""
        self._cuts.labels(reason).inc()

    def worker_event(self, event: WorkerEvent) -> None:
        """Counts an event in the life of the worker processes."""
        self._worker_events.labels(event).inc()

    def store_failed(self) -> None:
        """Counts an operation of the session store that failed."""
        self._store_failures.inc()

    def refused(self, code: str) -> None:
        """Counts an error sent to a client."""
        self._refusals.labels(code).inc()

    def timestamp_warning(self, code: WarningCode) -> None:
        """Counts a warning sent to a client because of its timestamps."""
        self._timestamp_warnings.labels(code).inc()

    def loaded(self, info: DetectorInfo) -> None:
        """Reports a detector that is ready, and its network."""
        network = info.model
        device = "gpu" if network.provider in _ON_GPU else "cpu"
        metadata = network.metadata
        self._provider.labels(network.name, network.provider, device, metadata.get("precision", "unknown")).set(1)
        self._fallback.labels(network.name).set(network.fell_back)
        self._model.labels(metadata.get("name", network.name), metadata.get("version", "unknown"), network.sha256).set(
            1
        )

    def workers(self, pids: Callable[[], Sequence[int]]) -> None:
        """Reports the worker processes; `pids` returns their process ids."""
        self._registry.register(WorkerCollector(pids))

    def certificate(self, expires_at: Callable[[], float]) -> None:
        """Reports the certificate for https; `expires_at` returns when it expires, in seconds since 1970."""
        self._certificate_expiry.set_function(expires_at)

    def collect(self) -> Iterable[Metric]:
        """Returns all metrics with their current values."""
        return self._registry.collect()

    def exposition(self) -> bytes:
        """Returns all metrics in Prometheus' text format, media type `MEDIA_TYPE`."""
        return generate_latest(self._registry)

    def _counter(self, name: str, description: str, *labels: str) -> Counter:
        return Counter(name, description, labels, registry=self._registry)

    def _gauge(self, name: str, description: str, *labels: str) -> Gauge:
        return Gauge(name, description, labels, registry=self._registry)

    def _histogram(self, name: str, description: str, buckets: tuple[float, ...], *labels: str) -> Histogram:
        return Histogram(name, description, labels, buckets=buckets, registry=self._registry)


_MEMORY: Final = "process_resident_memory_bytes"
_CPU_TIME: Final = "process_cpu_seconds_total"


class WorkerCollector(Collector):
    """The number of worker processes and the resources they use in total; `pids` returns their process ids."""

    def __init__(self, pids: Callable[[], Sequence[int]]) -> None:
        self._pids = pids

    def collect(self) -> Iterable[Metric]:
        """Returns the current metrics."""
        pids = self._pids()
        used: dict[str, float] = defaultdict(float)
        for pid in pids:
            for metric in ProcessCollector(pid=partial(int, pid), registry=None).collect():
                for sample in metric.samples:
                    used[sample.name] += sample.value
        yield GaugeMetricFamily("lane_workers", "Worker processes that accept frames.", len(pids))
        yield GaugeMetricFamily(
            "lane_workers_resident_memory_bytes", "Resident memory of all worker processes.", used[_MEMORY]
        )
        yield CounterMetricFamily("lane_workers_cpu_seconds", "CPU time of all worker processes.", used[_CPU_TIME])
