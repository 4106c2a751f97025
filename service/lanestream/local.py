"""The engine in this process, for those who want lanes without a service: images in, the service's messages out."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from lanestream.engine import load_engine
from lanestream.imaging import MOST_PIXELS, ImageLimits, decode
from lanestream.messages import ProcessedFrame, lanes_message

if TYPE_CHECKING:
    from pathlib import Path

    from lanestream.engine import Engine
    from lanestream.inference.providers import Provider
    from lanestream.lanes import Image
    from lanestream.protocol import LanesMessage

# Who decodes a file of their own may give it more memory than a service gives to strangers.
_LIMITS: Final = ImageLimits(max_bytes=1 << 28, max_pixels=MOST_PIXELS)


class LocalEngine:
    """A warm engine that works in the calling thread."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    @classmethod
    def load(cls, model: Path | None, provider: Provider) -> LocalEngine:
        """The engine for a model file, the shipped one where None. Raises ModelError and ProviderError."""
        return cls(load_engine(model, provider))

    @property
    def model(self) -> str:
        """The model's name and version."""
        return self._engine.network.name

    @property
    def provider(self) -> str:
        """The execution provider that really runs it."""
        return self._engine.network.provider

    def open_camera(self, horizon: float | None = None) -> LocalCamera:
        """Lanes for the frames of one camera; `horizon` as a share of the image height, estimated where None."""
        return LocalCamera(self._engine, horizon)


class LocalCamera:
    """One camera's session."""

    def __init__(self, engine: Engine, horizon: float | None) -> None:
        self._engine = engine
        self._session = engine.open_session(horizon)

    def lanes(self, image: bytes | Image, *, seq: int, timestamp: float) -> LanesMessage:
        """The lanes of one frame: an image file, or BGR pixels (H, W, 3) uint8; `timestamp` in seconds.

        Raises ImageError where the file can't be decoded; the session is then as it was before.
        """
        started = time.perf_counter()
        pixels = decode(image, _LIMITS) if isinstance(image, bytes) else image
        decoded = time.perf_counter()
        result = self._engine.process(self._session, pixels, timestamp)
        total = 1e3 * (time.perf_counter() - started)
        timing = {"decode": 1e3 * (decoded - started), "queue": 0.0, **result.timing_ms, "total": total}
        return lanes_message(ProcessedFrame(pixels, replace(result, timing_ms=timing)), seq=seq, timestamp=timestamp)
