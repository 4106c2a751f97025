"""The engine in this process, for use without a service: takes images and returns the service's messages."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from lanestream.engine import load_engine, resolve_regressor
from lanestream.images.decoding import MOST_PIXELS, DecodedImage, ImageLimits, decode_reduced
from lanestream.inference.providers import RuntimeOptions
from lanestream.messages import ProcessedFrame, lanes_message
from lanestream.protocol import warning_message
from lanestream.road.view import WORKING_WIDTH
from lanestream.session import SessionOptions
from lanestream.tracking.departure import VehicleMotion

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from lanestream.engine import Engine
    from lanestream.inference.loaded_model import LoadedModel
    from lanestream.protocol import CameraModel, DepartureOptions, Indicator, LanesMessage, WarningMessage
    from lanestream.road.appearance import BoundaryKind
    from lanestream.road.curve import FloatArray
    from lanestream.road.view import Image
    from lanestream.session import Session

# A user's own files may use more memory than a service allows its clients.
_LIMITS: Final = ImageLimits(max_bytes=1 << 28, max_pixels=MOST_PIXELS)


class LocalEngine:
    """A warm engine that runs in the calling thread."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    @classmethod
    def load(
        cls, model: Path | None, provider: str, regressor: Path | None = None, threads: int | None = None
    ) -> LocalEngine:
        """Loads a model file and the regressor, by default the shipped ones; the path `none` omits the regressor.

        `threads` is the number of CPU threads of one run of a network; None: one for each processor. Raises ModelError
        and ProviderError.
        """
        return cls(load_engine(model, provider, resolve_regressor(regressor), RuntimeOptions(threads)))

    def network(self, detector: str | None = None) -> LoadedModel:
        """Returns the main model of `detector`, or of the default one. Raises NoDetectorError if it is not loaded."""
        return self._engine.main_model(detector)

    def open_camera(
        self,
        horizon: float | None = None,
        detector: str | None = None,
        camera: CameraModel | None = None,
        departure: DepartureOptions | None = None,
        *,
        kinds: Sequence[BoundaryKind] | None = None,
        single_image: bool = False,
    ) -> LocalCamera:
        """Returns one camera's session; `horizon` is a share of the image height, estimated if None.

        With a `camera` lanes are reported in meters too, and departures as `departure` says. Raises NoDetectorError if
        `detector` is not loaded. `kinds` are those of the boundaries to report, by default all. With `single_image`,
        only one frame will follow.
        """
        options = SessionOptions.of(horizon, detector, camera, departure, kinds=kinds)
        options = replace(options, single_image=single_image)
        return LocalCamera(self._engine, self._engine.open_session(options))


class LocalCamera:
    """One camera's session."""

    def __init__(self, engine: Engine, session: Session) -> None:
        self._engine = engine
        self._session = session
        self.warnings: tuple[WarningMessage, ...] = ()

    @property
    def nis(self) -> FloatArray:
        """The normalized innovations squared of the last frame, see `LaneTracker.nis`."""
        return self._session.nis

    def lanes(
        self,
        image: bytes | Image,
        *,
        seq: int,
        timestamp: float,
        speed: float | None = None,
        indicator: Indicator | None = None,
    ) -> LanesMessage:
        """Returns the lanes of one frame: an image file, or BGR pixels (H, W, 3) uint8; `timestamp` in seconds.

        The vehicle's `speed` in m/s and its `indicator` are for departure warnings. What is wrong with the frames
        without being an error is added to `warnings`. Raises ImageError if the file cannot be decoded, and leaves the
        session as it was.
        """
        started = time.perf_counter()
        picture = decode_reduced(image, _LIMITS, WORKING_WIDTH) if isinstance(image, bytes) else DecodedImage(image)
        decoded = time.perf_counter()
        motion = VehicleMotion(speed, indicator)
        result = self._engine.process(self._session, picture.image, timestamp, motion, picture.size)
        self.warnings += tuple(warning_message(code, seq) for code in result.warnings)
        total = 1e3 * (time.perf_counter() - started)
        timing = {"decode": 1e3 * (decoded - started), "queue": 0.0, **result.timing_ms, "total": total}
        frame = ProcessedFrame.of(picture, result, timing)
        return lanes_message(frame, seq=seq, timestamp=timestamp)
