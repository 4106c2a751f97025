"""Estimates where a camera points while its vehicle drives.

On a straight road that the vehicle keeps to, the road's direction is the vehicle's on average. So the mean direction of
the road's vanishing point over such stretches gives the camera's yaw, and its height in the image the pitch. Which
frames count, and how their means are kept in blocks, follows openpilot's calibrationd: the vehicle drives faster than
15 mph, the road does not turn, blocks of 100 frames, 5 needed, 50 kept. Unlike there, the result is the mean of the
middle half of the blocks, and the mount counts as moved once two blocks in a row say so: one bad block changes nothing.
"""

from __future__ import annotations

import math
from base64 import b64decode, b64encode
from dataclasses import dataclass
from typing import Final

import numpy as np

from lanestream.road.camera import Camera, Lens, camera_from_vehicle
from lanestream.road.curve import FloatArray
from lanestream.road.results import Calibration, CalibrationChanged, Estimate, RoadEstimate
from lanestream.tracking.state import check_range

_BLOCK_FRAMES: Final = 100
_NEEDED: Final = 5
_KEPT: Final = 50
# The block in progress counts, so that 20 seconds at 25 frames per second are enough with some gaps.
FRAMES_NEEDED: Final = (_NEEDED - 1) * _BLOCK_FRAMES + 1
# A vehicle that reports its speed must be faster than this (m/s, 15 mph), and turn by less than this (radians/s).
_LEAST_SPEED: Final = 15.0 * 0.44704
_MOST_TURN: Final = math.radians(2.0)
# The speed that is assumed for the turn of one that does not (m/s). It lets wide curves of highways count, in which the
# road's direction at the vehicle is known just as well.
_USUAL_SPEED: Final = 10.0
# The vehicle must move sideways by less than this (m/s), and the sigma of the road's direction be less than this
# (radians). Then it neither changes lanes nor guesses.
_MOST_SIDEWAYS: Final = 0.35
_MOST_SIGMA: Final = math.radians(1.5)
# Differences in degrees by which a mount has moved: of pitch and yaw.
_MOVED: Final = np.array([4.0, 2.0])
# Blocks are kept in these steps in degrees, and no camera points farther away than this.
_STEP: Final = 0.01
_FARTHEST: Final = 90.0
# Blocks share errors, such as those of the lens, so the estimate has at least this sigma in degrees; and before two
# blocks can be compared, this one.
_LEAST_SIGMA: Final = 0.05
_FIRST_SIGMA: Final = 0.5
_NUMBERS: Final = "<i2"
_BLOCK_BYTES: Final = 4


@dataclass(frozen=True)
class CalibrationState:
    """The state of a calibrator.

    `blocks` are the pitch and yaw of complete blocks in steps of 0.01 degrees: little-endian int16 in base 64.
    `frames` of the block in progress have the sums `pitch_sum` and `yaw_sum` in degrees. `known` says whether the
    direction was settled before, even if the mount has moved since.
    """

    blocks: str = ""
    frames: int = 0
    pitch_sum: float = 0.0
    yaw_sum: float = 0.0
    known: bool = False

    @property
    def used(self) -> int:
        """The number of frames in its blocks."""
        return len(b64decode(self.blocks)) // _BLOCK_BYTES * _BLOCK_FRAMES + self.frames

    def validate(self) -> None:
        """Checks a state from outside this process. Raises ValueError, on one line, if no calibrator can have it."""
        try:
            size = len(b64decode(self.blocks, validate=True))
        except ValueError:
            raise ValueError("the blocks of the calibration are not valid base 64") from None
        if size % _BLOCK_BYTES or size > _KEPT * _BLOCK_BYTES:
            raise ValueError(f"the calibration has {size} bytes of blocks; expected at most {_KEPT} x {_BLOCK_BYTES}")
        check_range("calibration frames", self.frames, 0, _BLOCK_FRAMES - 1)
        for name, value in (("pitch_sum", self.pitch_sum), ("yaw_sum", self.yaw_sum)):
            check_range(f"calibration {name}", value, -_FARTHEST * self.frames, _FARTHEST * self.frames)


class Calibrator:
    """Estimates pitch and yaw of `camera`. `state` is all that it remembers."""

    def __init__(self, camera: Camera, state: CalibrationState | None = None) -> None:
        self.camera = camera
        self.state = state or CalibrationState()

    @property
    def result(self) -> Calibration:
        """The direction so far: the configured one, or 0, before the first frames."""
        blocks, state = _unpacked(self.state.blocks), self.state
        if len(blocks):
            pitch, yaw = _middle(blocks).tolist()
            sigmas = np.maximum(blocks.std(axis=0) / math.sqrt(len(blocks)), _LEAST_SIGMA)
        elif state.frames:
            pitch, yaw = state.pitch_sum / state.frames, state.yaw_sum / state.frames
            sigmas = np.full(2, _FIRST_SIGMA)
        else:
            pitch = yaw = 0.0
            sigmas = np.full(2, _FARTHEST)
        if len(blocks) == 1:
            sigmas[:] = _FIRST_SIGMA
        return Calibration(
            _estimate(self.camera.fixed_pitch, pitch, sigmas[0]),
            _estimate(self.camera.fixed_yaw, yaw, sigmas[1]),
            settled=self._settled,
        )

    @property
    def _settled(self) -> bool:
        return self.state.used >= FRAMES_NEEDED

    @property
    def yaw(self) -> Estimate:
        """The yaw for meters in degrees: as configured, or as estimated once it is known, 0 before that."""
        if self.camera.fixed_yaw is not None:
            return Estimate(self.camera.fixed_yaw, 0.0)
        return self.result.yaw if self._settled or self.state.known else Estimate(0.0, 0.0)

    def update(
        self, road: RoadEstimate, horizon: float, lens: Lens, timestamp: float, speed: float | None = None
    ) -> CalibrationChanged | None:
        """Takes the road and the horizon of a frame in pixels of `lens`, and the `speed` in m/s if it is known.

        Returns an event if the mount has moved.
        """
        pitch = self.camera.pitch_at(lens, road.vanishing_column.value, horizon)
        heading = self._heading(road.vanishing_column.value, horizon, pitch, lens)
        sideways = road.lateral_rate.value * self.camera.height
        # A vehicle that drifts to the right heads to the right of the road.
        drift = 0.0 if speed is None else math.atan2(sideways, max(speed, _LEAST_SPEED))
        pitch, yaw = math.degrees(pitch), math.degrees(drift - heading)
        curvature = 2.0 * road.curvature.value / (lens.fx**2 * self.camera.height)
        usable = (
            (speed is None or speed >= _LEAST_SPEED)
            and abs(curvature) * (_USUAL_SPEED if speed is None else speed) <= _MOST_TURN
            and abs(sideways) <= _MOST_SIDEWAYS
            and road.vanishing_column.sigma <= _MOST_SIGMA * lens.fx
            # Not true for NaN, which a lens that folds the image gives.
            and abs(pitch) <= _FARTHEST
            and abs(yaw) <= _FARTHEST
        )
        if not usable:
            return None
        state, known = self.state, self.state.known or self._settled
        self.state = CalibrationState(
            state.blocks, state.frames + 1, state.pitch_sum + pitch, state.yaw_sum + yaw, known
        )
        return self._complete_block(timestamp) if self.state.frames == _BLOCK_FRAMES else None

    def _heading(self, column: float, row: float, pitch: float, lens: Lens) -> float:
        """Returns the angle from the camera's direction to the road's in radians, positive to the left."""
        x, y = lens.rays(np.array([column, row])).tolist()
        forward, left, _ = np.array([x, y, 1.0]) @ camera_from_vehicle(pitch, 0.0, math.radians(self.camera.roll))
        return math.atan2(left, forward)

    def _complete_block(self, timestamp: float) -> CalibrationChanged | None:
        """Adds the block in progress. If it and the last one say that the mount has moved, starts afresh with both."""
        state, blocks = self.state, _unpacked(self.state.blocks)
        block = np.round(np.array([state.pitch_sum, state.yaw_sum]) / state.frames / _STEP) * _STEP
        blocks = np.concatenate([blocks, block[None]])[-_KEPT:]
        before, newest = blocks[:-2], blocks[-2:]
        moved = len(before) > 0 and bool((np.abs(newest - _middle(before)) > _MOVED).any(axis=1).all())
        agrees = bool((np.abs(newest[0] - newest[-1]) < _MOVED).all())
        if moved and agrees:
            blocks = newest
        self.state = CalibrationState(_packed(blocks), known=state.known)
        if not (moved and agrees and state.known):
            return None
        pitch, yaw = self.result.pitch.value, self.result.yaw.value
        return CalibrationChanged(timestamp, pitch, yaw)


def _estimate(configured: float | None, estimated: float, sigma: float) -> Estimate:
    return Estimate(estimated, float(sigma)) if configured is None else Estimate(configured, 0.0)


def _unpacked(blocks: str) -> FloatArray:
    """Returns the pitch and yaw of blocks in degrees, (N, 2)."""
    return np.frombuffer(b64decode(blocks), _NUMBERS).reshape(-1, 2) * _STEP


def _middle(blocks: FloatArray) -> FloatArray:
    """Returns the interquartile mean (2,) of at least one block: nearly as robust as the median, and less noisy."""
    quarter = len(blocks) // 4
    mean: FloatArray = np.sort(blocks, axis=0)[quarter : len(blocks) - quarter].mean(axis=0)
    return mean


def _packed(blocks: FloatArray) -> str:
    return b64encode(np.round(blocks / _STEP).astype(_NUMBERS).tobytes()).decode()
