"""A service whose detector only waits, as if a GPU did the work; everything else is the real service.

python -m capacity.waiting_node TIMES PORT: TIMES is a JSON file with a list of seconds, of which each frame takes one.
"""

from __future__ import annotations

import json
import random
import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from lanestream.api.server import serve
from lanestream.detection.interface import Detections, FrameContext, Infer
from lanestream.engine import Engine, load_engine
from lanestream.road.view import Image, RoadView
from lanestream.settings import load_settings


@dataclass(frozen=True)
class WaitingDetector:
    """Takes a random one of `seconds` for each frame, without using the processor, and finds nothing."""

    seconds: tuple[float, ...]

    def detect(self, image: Image, context: FrameContext, infer: Infer) -> Detections:
        """Waits, and reports how long as the time for fitting curves."""
        del context, infer
        began = time.perf_counter()
        time.sleep(random.choice(self.seconds))  # noqa: S311
        height, width = image.shape[:2]
        view = RoadView(width, height, 0.45 * height)
        return Detections((), view, 0.0, fit_s=time.perf_counter() - began)


def load_waiting_engine(times: Path) -> Engine:
    """Returns the usual engine, with a detector that waits."""
    seconds = tuple(json.loads(times.read_text(encoding="utf-8")))
    engine = load_engine(provider="cpu")
    return replace(engine, detectors=dict.fromkeys(engine.detectors, WaitingDetector(seconds)))


if __name__ == "__main__":
    # Its workers import this module by its name, not as the main program.
    from capacity import waiting_node

    serve(load_settings(port=int(sys.argv[2])), partial(waiting_node.load_waiting_engine, Path(sys.argv[1]).resolve()))
