"""What is counted and measured of the service, for Prometheus: base units, reasons as labels, one registry per app."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final, Literal, get_args

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, PlatformCollector, ProcessCollector
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4, generate_latest

from lanestream.api.worker_metrics import WorkerCollector
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

if TYPE_CHECKING:
    from lanestream.inference.batcher import BatchReport
    from lanestream.workers.capabilities import Offer

DropReason = Literal["superseded", "expired", "overload", "decode_error", "too_large", "rate", "disconnected", "error"]
ResumeResult = Literal["resumed", "unknown", "refused"]

MEDIA_TYPE: Final = CONTENT_TYPE_PLAIN_0_0_4

# Why a frame that was received got no lanes, by the code of its error; of any other code: `error`.
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
# The sum of all stages, which is none of them.
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
        self._received = self._counter("lane_frames_received_total", "Frames that came, streamed or single.")
        self._processed = self._counter("lane_frames_processed_total", "Frames that were answered with lanes.")
        self._dropped = self._counter("lane_frames_dropped_total", "Frames that came and got no lanes.", "reason")
        self._refusals = self._counter("lane_refusals_total", "Errors that clients were told.", "code")
        self._resumed = self._counter("lane_sessions_resumed_total", "Attempts to resume a session.", "result")
        self._closes = self._counter("lane_ws_closes_total", "WebSockets that were closed, by close code.", "code")
        self._sessions = self._gauge("lane_sessions_active", "Streams that have a session.")
        self._tasks = self._gauge("lane_tasks", "Tasks of the event loop.")
        self._queue = self._gauge("lane_queue_depth", "Questions that waited on when the last batch began.")
        self._provider = self._gauge(
            "lane_inference_provider_info", "What runs a network.", "network", "provider", "device", "precision"
        )
        self._fallback = self._gauge(
            "lane_provider_fallback", "1 where a better provider is installed and can't be used.", "network"
        )
        self._model = self._gauge("lane_model_info", "The file of a network.", "name", "version", "sha256")
        self._stages = self._histogram(
            "lane_stage_seconds", "Time of the stages of an answered frame.", _STAGE_BUCKETS, "stage"
        )
        self._age = self._histogram("lane_frame_age_seconds", "From a frame's arrival to its lanes.", _AGE_BUCKETS)
        self._batch_size = self._histogram(
            "lane_batch_size", "Inputs that a network took at once.", _BATCH_BUCKETS, "network"
        )
        self._batch_wait = self._histogram(
            "lane_batch_wait_seconds", "How long the oldest question of a batch had waited.", _STAGE_BUCKETS, "network"
        )
        # What never happened so far is 0, not absent: a rate over an absent series is no rate.
        for reason in get_args(DropReason):
            self._dropped.labels(reason)
        for result in get_args(ResumeResult):
            self._resumed.labels(result)

    def frame_received(self) -> None:
        """A frame came. `frame_processed`, `frame_dropped` or `frame_failed` tells what became of it."""
        self._received.inc()

    def frame_dropped(self, reason: DropReason) -> None:
        """A frame that came will have no lanes."""
        self._dropped.labels(reason).inc()

    def frame_failed(self, error: BaseException) -> None:
        """A frame that came will have no lanes because of `error`."""
        code = error.code if isinstance(error, LanestreamError) else LanestreamError.code
        self.frame_dropped(_DROP_REASONS.get(code, "error"))

    def frame_processed(self, timing_ms: Mapping[str, float], age_s: float) -> None:
        """A frame was answered: milliseconds of its stages, and seconds from its arrival to its reply."""
        self._processed.inc()
        self._age.observe(age_s)
        for stage, spent in timing_ms.items():
            if stage != _TOTAL:
                self._stages.labels(stage).observe(1e-3 * spent)

    def batch(self, report: BatchReport) -> None:
        """A network ran."""
        self._batch_size.labels(report.network).observe(report.rows)
        self._batch_wait.labels(report.network).observe(report.oldest_s)
        self._queue.set(report.still_waiting)

    def session_opened(self) -> None:
        """One more stream has a session."""
        self._sessions.inc()

    def session_closed(self) -> None:
        """One stream less has a session."""
        self._sessions.dec()

    def tasks(self, count: int) -> None:
        """How many tasks the event loop has just now."""
        self._tasks.set(count)

    def session_resumed(self, result: ResumeResult) -> None:
        """A client came with a resume token."""
        self._resumed.labels(result).inc()

    def socket_closed(self, code: int) -> None:
        """A WebSocket was closed with this code, by either side."""
        self._closes.labels(str(code)).inc()

    def refused(self, code: str) -> None:
        """A client was told an error of this code."""
        self._refusals.labels(code).inc()

    def loaded(self, offer: Offer) -> None:
        """A detector is ready, with a network."""
        network = offer.network
        device = "gpu" if network.provider in _ON_GPU else "cpu"
        told = network.metadata
        self._provider.labels(network.name, network.provider, device, told.get("precision", "unknown")).set(1)
        self._fallback.labels(network.name).set(network.fell_back)
        self._model.labels(told.get("name", network.name), told.get("version", "unknown"), network.sha256).set(1)

    def workers(self, pids: Callable[[], Sequence[int]]) -> None:
        """There may be worker processes; `pids` tells their numbers."""
        self._registry.register(WorkerCollector(pids))

    def exposition(self) -> bytes:
        """All of it in Prometheus' text format, of the type `MEDIA_TYPE`."""
        return generate_latest(self._registry)

    def _counter(self, name: str, meaning: str, *labels: str) -> Counter:
        return Counter(name, meaning, labels, registry=self._registry)

    def _gauge(self, name: str, meaning: str, *labels: str) -> Gauge:
        return Gauge(name, meaning, labels, registry=self._registry)

    def _histogram(self, name: str, meaning: str, buckets: tuple[float, ...], *labels: str) -> Histogram:
        return Histogram(name, meaning, labels, buckets=buckets, registry=self._registry)
