"""Lanestream's metrics as metrics of Ray, which collects those of all replicas and adds the replica as a label."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from lanestream.errors import needs_extra

with needs_extra("cluster"):
    from ray.serve.metrics import Gauge

if TYPE_CHECKING:
    from collections.abc import Iterable

    from prometheus_client import Metric


class RayMetrics:
    """Copies samples to gauges of Ray. Ray's exporter puts `ray_` before their names.

    Every sample is a gauge, also those of counters and histograms, which Ray could only count itself. Prometheus
    computes rates and quantiles of them all the same.
    """

    def __init__(self) -> None:
        self._gauges: dict[str, Any] = {}

    def export(self, metrics: Iterable[Metric]) -> None:
        """Sets the gauges to the values of these metrics."""
        for metric in metrics:
            for sample in metric.samples:
                # A time of creation is of no use, and takes as many series as the values.
                if sample.name.endswith("_created"):
                    continue
                gauge = self._gauges.get(sample.name)
                if gauge is None:
                    gauge = Gauge(sample.name, metric.documentation, tag_keys=tuple(sample.labels))
                    self._gauges[sample.name] = gauge
                gauge.set(sample.value, tags=sample.labels)
