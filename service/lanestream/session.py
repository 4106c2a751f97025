"""One camera: detect, then track. Its state is a small value."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.interface import Detections, Detector, FrameContext, Infer, ModelRole
from lanestream.errors import ProtocolError, one_line
from lanestream.images.resizing import working_image
from lanestream.images.scene_cut import SceneMemory
from lanestream.protocol import CameraModel, DepartureOptions
from lanestream.road.appearance import BOUNDARY_KINDS, BoundaryKind
from lanestream.road.camera import Camera, Lens
from lanestream.road.curve import FloatArray
from lanestream.road.ground import with_meters
from lanestream.road.results import EgoMeters, FrameResult, SceneCut
from lanestream.road.view import Image, Scaling
from lanestream.tracking.calibration import CalibrationState, Calibrator
from lanestream.tracking.departure import (
    UNKNOWN_MOTION,
    DepartureMonitor,
    DepartureSettings,
    DepartureState,
    VehicleMotion,
)
from lanestream.tracking.state import MAX_COUNT, TrackerState, check_range
from lanestream.tracking.tracker import LaneTracker

# The least weight of a new frame's horizon: bumps should not move the estimate, a minute of driving should.
_HORIZON_GAIN: Final = 0.1
# A horizon is doubtful after so many seconds in which the ego-lane prior was more uncertain than this. It is then
# searched for again. One that is found this far away, in depths, replaces the estimate at once.
_DOUBTFUL_S: Final = 1.0
_MOST_UNCERTAINTY: Final = 0.06
_MOVED: Final = 0.1
# The limits of a saved state: a side of a working image in pixels, and the row of a horizon as a share of the height.
# Detectors place no horizon lower, because some road must be visible below it, and none higher: cameras that look down
# have theirs up to the height of an image above it, and wide images are low.
_LONGEST_SIDE: Final = 1 << 20
_HORIZONS: Final = (-2.0, 0.98)
# How exactly the lowest row of a road filter is that of the images, in pixels.
_ROUNDING: Final = 1e-3


@dataclass(frozen=True)
class SessionOptions:
    """What the caller of a session chooses.

    `horizon` is its row as a share of the image height, negative above the image; if None, it is estimated. `detector`
    is the name of the detector, by default the service's. With a `camera`, results are also in meters, and departures
    are warned of as `departure` says. With `single_image`, every boundary of the first frame is reported: no other
    frame will follow that could confirm it. Only boundaries of the `kinds` are reported.
    """

    horizon: float | None = None
    detector: str | None = None
    camera: Camera | None = None
    departure: DepartureSettings = DepartureSettings()
    single_image: bool = False
    kinds: tuple[BoundaryKind, ...] = BOUNDARY_KINDS

    @classmethod
    def of(
        cls,
        horizon: float | None,
        detector: str | None,
        camera: CameraModel | None,
        departure: DepartureOptions | None = None,
        defaults: DepartureSettings | None = None,
        kinds: Sequence[BoundaryKind] | None = None,
    ) -> SessionOptions:
        """Returns the options that a client sends; `defaults` are those of `departure`. `kinds` defaults to all.

        Raises ProtocolError if two of them contradict each other, or if no kind or an unknown one is given.
        """
        if horizon is not None and camera is not None and isinstance(camera.pitch, float):
            raise ProtocolError("the horizon and the camera's pitch are both given", "give one; each implies the other")
        if kinds is not None and (not kinds or not set(kinds) <= set(BOUNDARY_KINDS)):
            given = one_line(", ".join(kinds), 80) or "none"
            raise ProtocolError(f"the kinds of boundaries to report are {given}", "give marking, road_edge or both")
        known = None if camera is None else Camera(**camera.model_dump())
        chosen = {} if departure is None else departure.model_dump(exclude_none=True)
        return cls(
            horizon,
            detector,
            known,
            replace(defaults or DepartureSettings(), **chosen),
            kinds=BOUNDARY_KINDS if kinds is None else tuple(kinds),
        )


DEFAULT_SESSION: Final = SessionOptions()


@dataclass(frozen=True)
class SessionState:
    """The state of a session as a small value.

    `size` is the width and height of its working images. `horizon` is the camera's estimate and `prior_horizon` the
    ego-lane prior's in the last frame, both as shares of the height. `evidence` is the sum of the frames' horizon
    weights, and `uncertain_s` for how long the prior has been uncertain.
    """

    size: tuple[int, int] | None = None
    horizon: float | None = None
    prior_horizon: float | None = None
    evidence: float = 0.0
    uncertain_s: float = 0.0
    tracker: TrackerState = field(default_factory=TrackerState)
    calibration: CalibrationState = field(default_factory=CalibrationState)
    departure: DepartureState = field(default_factory=DepartureState)
    scene: SceneMemory = SceneMemory()

    def validate(self) -> None:
        """Checks a state from outside this process. Raises ValueError, on one line, if no session can have it."""
        if self.size is not None and not all(0 < side <= _LONGEST_SIDE for side in self.size):
            raise ValueError(f"a side of the images is not between 1 and {_LONGEST_SIDE} pixels")
        check_range("horizon", self.horizon, *_HORIZONS)
        check_range("prior_horizon", self.prior_horizon, *_HORIZONS)
        check_range("evidence", self.evidence, 0.0, MAX_COUNT)
        check_range("uncertain_s", self.uncertain_s, 0.0, _DOUBTFUL_S)
        self.tracker.validate()
        bottom = self.tracker.horizon + self.tracker.depth
        if self.tracker.filter and (self.size is None or abs(bottom + 1.0 - self.size[1]) > _ROUNDING):
            raise ValueError("the road filter does not fit the size of the images")
        self.calibration.validate()
        self.departure.validate()
        self.scene.validate()


class Session:
    """Tracks the lanes of one camera, frame by frame.

    Unless `options` has a horizon, it is estimated from the frames and smoothed over time. A frame of another size than
    the last one resets the tracker.
    """

    def __init__(self, detector: Detector, options: SessionOptions = DEFAULT_SESSION) -> None:
        self._detector = detector
        self._configured = options.horizon
        self._camera = options.camera
        self._calibrator = None if options.camera is None else Calibrator(options.camera)
        self._size: tuple[int, int] | None = None
        self._horizon: float | None = None
        self._prior_horizon: float | None = None
        self._evidence = 0.0
        self._uncertain_s = 0.0
        self._single_image, self._kinds = options.single_image, options.kinds
        self._tracker = LaneTracker(options.single_image, options.kinds)
        self._scene = SceneMemory()
        self._departure = DepartureMonitor(options.departure)

    @property
    def state(self) -> SessionState:
        """The complete state. Do not read it while a frame is being processed."""
        return SessionState(
            self._size,
            self._horizon,
            self._prior_horizon,
            self._evidence,
            self._uncertain_s,
            self._tracker.state,
            CalibrationState() if self._calibrator is None else self._calibrator.state,
            self._departure.state,
            self._scene,
        )

    @property
    def nis(self) -> FloatArray:
        """The normalized innovations squared of the last frame, see `LaneTracker.nis`."""
        return self._tracker.nis

    def restore(self, state: SessionState, ids_lost: int = 0) -> None:
        """Continues where `state` was taken; `ids_lost` more track ids count as assigned.

        Raises ValueError for an incomplete state, and leaves the session as it was. A state from outside this process
        needs `SessionState.validate` first, which takes too long for every frame.
        """
        self._tracker = LaneTracker.restored(state.tracker, ids_lost, self._single_image, self._kinds)
        self._size, self._horizon, self._evidence = state.size, state.horizon, state.evidence
        self._prior_horizon, self._uncertain_s = state.prior_horizon, state.uncertain_s
        self._departure.state = state.departure
        self._scene = state.scene
        if self._calibrator is not None:
            self._calibrator.state = state.calibration

    def process(
        self,
        image: Image,
        timestamp: float,
        infer: Infer,
        motion: VehicleMotion = UNKNOWN_MOTION,
        size: tuple[int, int] | None = None,
    ) -> FrameResult:
        """Returns the lanes of one frame, a BGR image (H, W, 3) uint8, in pixels of that image.

        `timestamp` is the capture time in seconds, and `motion` what the vehicle reported then. `size` is the width and
        height of the frame if `image` is a smaller copy of it. Frames of a session are processed one at a time, in
        order. The result's timing has the milliseconds of `propose` (without waiting for `infer`), `fit` and `track`.
        If `infer` raises, the session stays as it was.
        """
        started = time.perf_counter()
        working, scaling = working_image(image)
        height, width = working.shape[:2]
        lens, middle = None, 0.0
        if self._camera is not None:
            lens = self._camera.lens(size or (image.shape[1], image.shape[0]), (width, height))
            middle = self._camera.middle(lens)
        seconds = self._tracker.seconds_until(timestamp)
        scene, is_cut = self._scene.next(working, seconds)
        inference = _TimedInference(infer)
        context = self._context(image, working, scaling, lens, is_cut)
        detections = self._detector.detect(working, context, inference)
        detected = time.perf_counter()
        self._scene = scene
        self._update_horizon(detections, is_cut, context, seconds)
        result = self._tracker.update(detections.boundaries, timestamp, detections.view, middle, is_cut)
        if any(isinstance(event, SceneCut) for event in result.events):
            self._departure.state = DepartureState()
        if self._calibrator is not None and lens is not None:
            result = _with_meters(result, self._calibrator, lens, height - 1.0, timestamp, motion.speed)
        result = result.to_image(scaling)
        result.timing_ms.update(
            propose=1e3 * (detected - started - inference.waited_s - detections.fit_s),
            fit=1e3 * detections.fit_s,
            track=1e3 * (time.perf_counter() - detected),
        )
        return self._watch_departure(result, timestamp, motion)

    def _watch_departure(self, result: FrameResult, timestamp: float, motion: VehicleMotion) -> FrameResult:
        """Adds the departure and its events, if the camera is known."""
        if self._camera is None:
            return result
        ego = result.ego
        meters = ego.meters or EgoMeters()
        departure, events = self._departure.update(meters, ego.left, ego.right, timestamp, motion)
        return replace(result, departure=departure, events=result.events + events)

    def _context(self, image: Image, working: Image, scaling: Scaling, lens: Lens | None, is_cut: bool) -> FrameContext:
        height, width = working.shape[:2]
        is_known = self._size == (width, height) and not is_cut
        given: float | None = None
        if self._configured is not None:
            given = scaling.to_working(self._configured * image.shape[0])
        elif self._camera is not None and lens is not None and self._camera.fixed_pitch is not None:
            given = self._camera.horizon(lens, height)
        estimated = None if self._horizon is None or is_cut else self._horizon * height
        return FrameContext(
            horizon=estimated if given is None else given,
            is_given=given is not None,
            tracked=self._tracker.curves if is_known else None,
            confirmed=self._tracker.confirmed_curves if is_known else None,
            prior_horizon=None if self._prior_horizon is None or not is_known else self._prior_horizon * height,
            is_doubtful=given is None and self._uncertain_s >= _DOUBTFUL_S,
        )

    def _update_horizon(self, detections: Detections, is_cut: bool, context: FrameContext, seconds: float) -> None:
        """Updates the horizon with a weighted mean of the frames' horizons that forgets old frames slowly.

        The frame was `seconds` after the last one, and detected with this `context`.
        """
        view = detections.view
        size = view.width, view.height
        if self._size not in (None, size):
            self._tracker = LaneTracker(self._single_image, self._kinds)
            self._departure.state = DepartureState()
        expected = context.expected_horizon
        found_anew = context.is_doubtful and expected is not None and abs(view.horizon - expected) > _MOVED * view.depth
        if self._size not in (None, size) or is_cut or found_anew:
            self._horizon, self._evidence = None, 0.0
        certain = detections.uncertainty <= _MOST_UNCERTAINTY or context.is_doubtful
        self._uncertain_s = 0.0 if certain else min(self._uncertain_s + seconds, _DOUBTFUL_S)
        self._size = size
        prior_horizon = detections.prior_horizon
        self._prior_horizon = None if prior_horizon is None else prior_horizon / view.height
        share, weight = view.horizon / view.height, detections.horizon_weight
        self._evidence += weight
        gain = max(_HORIZON_GAIN * weight, weight / max(self._evidence, 1e-6))
        self._horizon = share if self._horizon is None else self._horizon + gain * (share - self._horizon)


def _with_meters(
    result: FrameResult, calibrator: Calibrator, lens: Lens, bottom: float, timestamp: float, speed: float | None
) -> FrameResult:
    """Adds meters to a result in pixels of `lens`, and the camera's direction if it is to be estimated."""
    result = with_meters(result, calibrator.camera, lens, calibrator.yaw, bottom)
    if not calibrator.camera.calibrates:
        return result
    event = None
    if result.road is not None and any(lane.state == "detected" for lane in result.lanes):
        event = calibrator.update(result.road, result.horizon, lens, timestamp, speed)
    events = result.events if event is None else (*result.events, event)
    return replace(result, calibration=calibrator.result, events=events)


class _TimedInference:
    """Calls `infer` and sums up the seconds that the calls take."""

    def __init__(self, infer: Infer) -> None:
        self._infer = infer
        self.waited_s = 0.0

    def __call__(self, role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        started = time.perf_counter()
        try:
            return self._infer(role, inputs)
        finally:
            self.waited_s += time.perf_counter() - started
