"""What is said at the end of a run: how many frames, how fast, how much of the road was seen."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from lanestream.protocol import TimingModel

if TYPE_CHECKING:
    from lanestream.protocol import LanesMessage
    from lanestream_client.service import ServiceInfo


class Tally:
    """Counts what came back, from its creation on."""

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._timings: list[TimingModel] = []
        self._with_both = 0
        self.failed = 0
        self.lost = 0

    def answered(self, lanes: LanesMessage) -> None:
        """One frame has its lanes."""
        self._timings.append(lanes.timing_ms)
        self._with_both += lanes.ego.left is not None and lanes.ego.right is not None

    def fail(self, *, lost: bool = False) -> None:
        """One frame has none, but an error; `lost` where its answer was lost on the way."""
        if lost:
            self.lost += 1
        else:
            self.failed += 1

    @property
    def frames(self) -> int:
        """How many came back, with or without lanes."""
        return len(self._timings) + self.failed + self.lost

    def report(self, info: ServiceInfo, dropped: int = 0) -> str:
        """The closing lines."""
        answered = len(self._timings)
        rate = answered / max(time.monotonic() - self._started, 1e-9)
        lost = f", {self.lost} lost" if self.lost else ""
        lines = [
            f"{self.frames + dropped} frames: "
            f"{answered} answered, {dropped} dropped, {self.failed} failed{lost}; {rate:.1f} frames/s"
        ]
        if answered:
            lines += [f"both ego boundaries in {100.0 * self._with_both / answered:.1f} % of the answered frames", ""]
            lines += [f"{'ms':<8}{'p50':>9}{'p95':>9}", *(self._stage(stage) for stage in TimingModel.model_fields), ""]
        lines.append(f"model {info.model} on {info.provider}")
        return "\n".join(lines)

    def _stage(self, stage: str) -> str:
        values = sorted(getattr(timing, stage) for timing in self._timings)
        return f"{stage:<8}{percentile(values, 50):>9.2f}{percentile(values, 95):>9.2f}"


def percentile(ordered: Sequence[float], share: float) -> float:
    """The nearest-rank percentile of values in rising order; `share` in percent."""
    return ordered[max(0, math.ceil(share / 100.0 * len(ordered)) - 1)]
