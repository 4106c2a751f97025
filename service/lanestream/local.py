"""The engine in this process, for those who want lanes without a service: images in, the service's messages out."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from lanestream.detection.features import WORKING_WIDTH
from lanestream.engine import load_engine, resolve_regressor
from lanestream.images.decoding import MOST_PIXELS, DecodedImage, ImageLimits, decode_reduced
from lanestream.messages import ProcessedFrame, lanes_message

if TYPE_CHECKING:
    from pathlib import Path

    from lanestream.detection import Network
    from lanestream.engine import Engine
    from lanestream.protocol import CameraModel, DetectorName, LanesMessage
    from lanestream.road.view import Image
    from lanestream.runtime import Provider
    from lanestream.session import Session

# Who decodes a file of their own may give it more memory than a service gives to strangers.
_LIMITS: Final = ImageLimits(max_bytes=1 << 28, max_pixels=MOST_PIXELS)


class LocalEngine:
    """A warm engine that works in the calling thread."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    @classmethod
    def load(cls, model: Path | None, provider: Provider, regressor: Path | None = None) -> LocalEngine:
        """The engine for a model file and the regressor beside it, the shipped ones where None.

        The path `none` goes without a regressor. Raises ModelError and ProviderError.
        """
        return cls(load_engine(model, provider, resolve_regressor(regressor)))

    def network(self, detector: DetectorName | None = None) -> Network:
        """The network of a detector, of the default one where None. Raises NoDetectorError where it is not loaded."""
        return self._engine.pipeline(detector).network

    def open_camera(
        self, horizon: float | None = None, detector: DetectorName | None = None, camera: CameraModel | None = None
    ) -> LocalCamera:
        """Lanes for the frames of one camera; `horizon` as a share of the image height, estimated where None.

        With a `camera` lanes are told in metres too. Raises NoDetectorError where `detector` is not loaded.
        """
        return LocalCamera(self._engine, self._engine.open_session(horizon, detector), camera)


class LocalCamera:
    """One camera's session."""

    def __init__(self, engine: Engine, session: Session, model: CameraModel | None) -> None:
        self._engine = engine
        self._session = session
        self._model = model

    def lanes(self, image: bytes | Image, *, seq: int, timestamp: float) -> LanesMessage:
        """The lanes of one frame: an image file, or BGR pixels (H, W, 3) uint8; `timestamp` in seconds.

        Raises ImageError where the file can't be decoded; the session is then as it was before.
        """
        started = time.perf_counter()
        picture = decode_reduced(image, _LIMITS, WORKING_WIDTH) if isinstance(image, bytes) else DecodedImage(image)
        decoded = time.perf_counter()
        result = self._engine.process(self._session, picture.image, timestamp)
        total = 1e3 * (time.perf_counter() - started)
        timing = {"decode": 1e3 * (decoded - started), "queue": 0.0, **result.timing_ms, "total": total}
        frame = ProcessedFrame.of(picture, result, timing)
        return lanes_message(frame, seq=seq, timestamp=timestamp, camera=self._model)
