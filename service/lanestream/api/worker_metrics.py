"""Metrics of the worker processes: the ones that every process tells of itself are those of the service's own."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Final

from prometheus_client import Metric, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

_MEMORY: Final = "process_resident_memory_bytes"
_PROCESSOR: Final = "process_cpu_seconds_total"


class WorkerCollector(Collector):
    """How many worker processes there are, and what they use together; `pids` tells their numbers."""

    def __init__(self, pids: Callable[[], Sequence[int]]) -> None:
        self._pids = pids

    def collect(self) -> Iterable[Metric]:
        """The metrics at this moment."""
        pids = self._pids()
        used: dict[str, float] = defaultdict(float)
        for pid in pids:
            for metric in ProcessCollector(pid=partial(int, pid), registry=None).collect():
                for sample in metric.samples:
                    used[sample.name] += sample.value
        yield GaugeMetricFamily("lane_workers", "Worker processes that take frames.", len(pids))
        yield GaugeMetricFamily("lane_workers_resident_memory_bytes", "Resident memory of them all.", used[_MEMORY])
        yield CounterMetricFamily("lane_workers_cpu_seconds", "Processor time of them all.", used[_PROCESSOR])
