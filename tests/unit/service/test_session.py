"""One camera's session: the context of each frame, its horizon, its timing, and exact restoring from its state."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import fakes
import numpy as np
import pytest
from numpy.typing import NDArray

from lanestream.detection.interface import Detections, FrameContext, Infer, ModelRole
from lanestream.engine import load_engine
from lanestream.errors import ExpiredError, ProtocolError
from lanestream.protocol import CameraModel
from lanestream.road.camera import Camera
from lanestream.road.results import FrameResult
from lanestream.road.view import Image
from lanestream.session import Session, SessionOptions
from lanestream.tracking.calibration import CalibrationState
from lanestream_exporter.scenes import Drive, render_clip, sample_clip


def infer(role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.zeros((len(inputs), 2), np.float32)


def expire(role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
    raise ExpiredError()


@dataclass
class ScriptedDetector(fakes.FakeDetector):
    """Finds the fake boundaries below the horizons of a script, and records the context of each frame."""

    horizons: list[tuple[float, float]]  # of each frame: the row as a share of the height, and its weight
    prior_horizon: float | None = None
    uncertainty: float = 0.0
    contexts: list[FrameContext] = field(default_factory=list)
    sizes: list[tuple[int, int]] = field(default_factory=list)

    def detect(self, image: Image, context: FrameContext, infer: Infer) -> Detections:
        self.contexts.append(context)
        self.sizes.append(image.shape[:2])
        share, weight = self.horizons.pop(0)
        found = super().detect(image, FrameContext(share * len(image)), infer)
        return replace(found, horizon_weight=weight, prior_horizon=self.prior_horizon, uncertainty=self.uncertainty)


def test_a_detector_gets_a_working_image_of_640_columns() -> None:
    detector = ScriptedDetector([(0.4, 1.0)] * 3)
    for width, height in ((320, 180), (640, 360), (1920, 1200)):
        result = Session(detector).process(fakes.picture(width, height), 0.0, infer)
        assert result.horizon == pytest.approx(0.4 * height, abs=2.0), "the result is in pixels of the image"
    assert detector.sizes == [(360, 640), (360, 640), (400, 640)]


def test_the_context_of_a_frame_comes_from_the_frames_before_it() -> None:
    detector = ScriptedDetector([(0.4, 1.0)] * 5, prior_horizon=150.0)
    session = Session(detector)
    for i in range(5):
        session.process(fakes.picture(640, 360), 0.04 * i, infer)
    first, second, *_, last = detector.contexts
    assert first == FrameContext()
    assert second.horizon == pytest.approx(144.0)
    assert second.prior_horizon == pytest.approx(150.0)
    assert last.tracked is not None, "once the boundaries are confirmed"
    columns = last.tracked.x(np.array([359.0]))[:, 0]
    assert columns == pytest.approx([319.5 - 1.15 * 215.0, 319.5 + 1.15 * 215.0], abs=1.0)


def test_a_horizon_above_the_image_is_configured_or_estimated_and_restored() -> None:
    detector = ScriptedDetector([(-0.2, 1.0)] * 4)
    session = Session(detector, SessionOptions(horizon=-0.2))
    result = session.process(fakes.picture(640, 360), 0.0, infer)
    assert detector.contexts[0].horizon == pytest.approx(-72.0, abs=0.5)
    assert result.horizon == pytest.approx(-72.0, abs=1.0)
    session = Session(detector)
    for frame in range(2):
        result = session.process(fakes.picture(640, 360), 0.04 * frame, infer)
    state = session.state
    state.validate()
    assert state.horizon == pytest.approx(-0.2)
    restored = Session(detector)
    restored.restore(state)
    restored.process(fakes.picture(640, 360), 0.08, infer)
    assert detector.contexts[-1].horizon == pytest.approx(-72.0)


def test_a_configured_horizon_stays() -> None:
    detector = ScriptedDetector([(0.5, 1.0)] * 3)
    session = Session(detector, SessionOptions(horizon=0.3))
    for i in range(3):
        session.process(fakes.picture(640, 360), 0.04 * i, infer)
    assert [context.horizon for context in detector.contexts] == [pytest.approx(108.0)] * 3


def test_the_horizon_is_smoothed_and_follows_slowly() -> None:
    detector = ScriptedDetector([(0.4, 1.0), (0.5, 1.0), (0.9, 0.0), *[(0.5, 1.0)] * 60])
    session = Session(detector)
    for i in range(63):
        session.process(fakes.picture(640, 360), 0.04 * i, infer)
    shares = [context.horizon / 360.0 for context in detector.contexts if context.horizon is not None]
    assert shares[:3] == pytest.approx([0.4, 0.45, 0.45]), "the mean so far; a frame without a weight says nothing"
    assert shares[-1] == pytest.approx(0.5, abs=0.01)
    assert all(later >= earlier for earlier, later in pairwise(shares))


def test_an_uncertain_horizon_becomes_doubtful_after_a_second() -> None:
    detector = ScriptedDetector([(0.4, 1.0)] * 60, uncertainty=0.2)
    session = Session(detector)
    for i in range(60):
        session.process(fakes.picture(640, 360), 0.04 * i, infer)
    doubtful = [i for i, context in enumerate(detector.contexts) if context.is_doubtful]
    assert doubtful == pytest.approx([26, 52], abs=1), "once a second, not in every frame"
    for detector in (ScriptedDetector([(0.4, 1.0)] * 60), ScriptedDetector([(0.4, 1.0)] * 60, uncertainty=0.2)):
        options = SessionOptions(horizon=0.4 if detector.uncertainty else None)
        session = Session(detector, options)
        for i in range(60):
            session.process(fakes.picture(640, 360), 0.04 * i, infer)
        assert not any(context.is_doubtful for context in detector.contexts), "certain, or configured"


@pytest.mark.parametrize(("row", "counts_at_once"), [(0.3, True), (0.42, False)])
def test_a_horizon_that_a_search_finds_elsewhere_counts_at_once(row: float, counts_at_once: bool) -> None:
    detector = ScriptedDetector([(0.4, 1.0)] * 40, uncertainty=0.2)
    session = Session(detector)
    while not (detector.contexts and detector.contexts[-1].is_doubtful):
        frame = len(detector.contexts)
        if session.state.uncertain_s >= 1.0:
            detector.horizons[0] = (row, 1.0)
        session.process(fakes.picture(640, 360), 0.04 * frame, infer)
    assert session.state.horizon == pytest.approx(row if counts_at_once else 0.4, abs=0.003)
    state = session.state
    state.validate()
    restored = Session(detector)
    restored.restore(state)
    assert restored.state == state


def test_another_size_resets_the_tracker() -> None:
    detector = ScriptedDetector([*[(0.4, 1.0)] * 5, (0.5, 1.0), (0.5, 1.0)], prior_horizon=150.0)
    session = Session(detector)
    results = [session.process(fakes.picture(640, 360), 0.04 * i, infer) for i in range(5)]
    assert len(results[-1].lanes) == 2
    results += [session.process(fakes.picture(640, 480), 0.04 * i, infer) for i in (5, 6)]
    assert [lane.age_s for lane in results[5].lanes] == [0.0, 0.0], "boundaries are new"
    assert detector.contexts[5].tracked is None
    assert detector.contexts[5].prior_horizon is None
    assert detector.contexts[6].horizon == pytest.approx(0.5 * 480), "the horizon of another size is forgotten"


def test_a_failed_frame_leaves_the_session_as_it_was() -> None:
    session = Session(fakes.FakeDetector())
    session.process(fakes.picture(), 0.0, infer)
    before = session.state
    with pytest.raises(ExpiredError):
        session.process(fakes.picture(320, 240), 0.04, expire)
    with pytest.raises(RuntimeError, match="the detector failed"):
        session.process(np.full((180, 320, 3), 255, np.uint8), 0.04, infer)
    assert session.state == before


def test_timing_has_the_stages_without_the_wait_for_the_models() -> None:
    def slow(role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        fakes.pause(0.05)
        return infer(role, inputs)

    timing = Session(fakes.FakeDetector()).process(fakes.picture(), 0.0, slow).timing_ms
    assert set(timing) == {"propose", "fit", "track"}
    assert 0.0 <= timing["propose"] < 50.0


def exact(result: FrameResult) -> list[object]:
    """Returns all numbers of a result bit for bit, without timing."""
    lanes = [
        (
            replace(lane, covariance=None, ground_covariance=None),  # type: ignore[arg-type]
            lane.covariance.tobytes(),
            None if lane.ground_covariance is None else lane.ground_covariance.tobytes(),
        )
        for lane in result.lanes
    ]
    return [lanes, result.ego, result.horizon, result.events]


@pytest.mark.parametrize("detector", ["candidates", "regression"])
def test_a_restored_session_gives_the_same_results_bit_for_bit(detector: str) -> None:
    clip = sample_clip(np.random.default_rng(24), 640, 360, frames=12, fps=25.0, drive=Drive("highway", fair=True))
    images = [frame.image for frame in render_clip(clip)]
    engine = load_engine(provider="cpu")
    original = engine.open_session(SessionOptions(detector=detector))
    for i, image in enumerate(images):
        # As worker processes do: a new session for each frame, which gets the state of the last one.
        restored = engine.open_session(SessionOptions(detector=detector))
        restored.restore(original.state)
        assert restored.state == original.state
        results = [engine.process(session, image, 0.04 * i) for session in (original, restored)]
        assert exact(results[0]) == exact(results[1])
        assert restored.state == original.state
    assert len(results[0].lanes) >= 2


def test_an_invalid_state_leaves_the_session_as_it_was() -> None:
    session = Session(fakes.FakeDetector())
    session.process(fakes.picture(), 0.0, infer)
    before = session.state
    with pytest.raises(ValueError):  # noqa: PT011 - whatever it says
        session.restore(replace(before, tracker=replace(before.tracker, filter="AAAA")))
    assert session.state == before


CAMERA = Camera(1.4, 62.0, pitch="auto", yaw="auto", lateral=0.2)


def drive(session: Session, frames: int, first: int = 0) -> FrameResult:
    """Returns the result of the last of `frames` frames, which follow the frame `first`."""
    for i in range(first, first + frames):
        result = session.process(fakes.picture(640, 360), 0.04 * i, infer)
    return result


def test_a_camera_adds_meters_and_its_direction() -> None:
    result = drive(Session(fakes.FakeDetector(), SessionOptions(camera=CAMERA)), 30)
    meters = result.ego.meters
    assert meters is not None
    assert meters.offset is not None
    assert meters.offset.value == pytest.approx(0.2, abs=0.01), "the camera is in the lane's middle"
    assert [lane.ground is not None for lane in result.lanes] == [True, True]
    assert result.calibration is not None
    assert result.calibration.yaw.value == pytest.approx(0.0, abs=0.1)
    assert result.departure is not None
    fixed = drive(Session(fakes.FakeDetector(), SessionOptions(camera=replace(CAMERA, pitch=None, yaw=0.0))), 30)
    assert fixed.calibration is None
    without = drive(Session(fakes.FakeDetector()), 30)
    assert (without.ego.meters, without.calibration, without.departure) == (None, None, None)


def test_the_pixels_of_a_camera_are_those_of_the_whole_frame() -> None:
    camera = Camera(1.4, focal_length=(1000.0, 1000.0), principal_point=(700.0, 359.5))
    session = Session(fakes.FakeDetector(), SessionOptions(camera=camera))
    for i in range(5):
        result = session.process(fakes.picture(640, 360), 0.04 * i, infer, size=(1280, 720))
    assert result.ego.meters is not None
    assert result.ego.meters.heading is not None
    assert result.ego.meters.heading.value == pytest.approx(np.arctan((700.0 - 639.5) / 1000.0), abs=1e-3)


def test_a_configured_pitch_fixes_the_horizon() -> None:
    detector = ScriptedDetector([(0.5, 1.0)] * 2)
    session = Session(detector, SessionOptions(camera=Camera(1.4, 62.0, pitch=3.0)))
    drive(session, 2)
    focal = 320.0 / np.tan(np.radians(31.0))
    expected = 179.5 - focal * np.tan(np.radians(3.0))
    assert [context.horizon for context in detector.contexts] == [pytest.approx(expected)] * 2


def test_a_horizon_and_a_pitch_contradict_each_other() -> None:
    camera = CameraModel(height=1.4, field_of_view=62.0, pitch=2.0)
    with pytest.raises(ProtocolError, match="the horizon and the camera's pitch are both given"):
        SessionOptions.of(0.4, None, camera)
    assert SessionOptions.of(0.4, None, camera.model_copy(update={"pitch": "auto"})).horizon == 0.4


def test_the_calibration_is_part_of_the_state() -> None:
    options = SessionOptions(camera=CAMERA)
    original = Session(fakes.FakeDetector(), options)
    drive(original, 20)
    restored = Session(fakes.FakeDetector(), options)
    restored.restore(original.state)
    restored.state.validate()
    assert original.state.calibration.frames > 10
    assert restored.state == original.state
    assert exact(drive(restored, 1, 20)) == exact(drive(original, 1, 20))
    assert restored.state.calibration == original.state.calibration
    with pytest.raises(ValueError, match="calibration frames is 100"):
        replace(original.state, calibration=CalibrationState(frames=100)).validate()
