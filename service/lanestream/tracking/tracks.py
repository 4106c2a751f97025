"""The life of one tracked boundary: tentative, confirmed, coasting, deleted."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from lanestream.road.appearance import Appearance
from lanestream.road.results import Detection, TrackState
from lanestream.tracking.appearance import accumulated, as_saved, forgotten

# The values of a track that are saved in single precision.
SINGLE_PRECISION: Final = ("probability", "top", "bottom", "place", "scale", "paint")
# A track is confirmed by this many hits within this many frames, and a tentative one deleted when it can't have them.
HITS: Final = 3
FRAMES: Final = 5
# A track coasts for this many times as long as it was supported, within these limits in seconds, but
# at least for so many frames.
_COAST_SHARE: Final = 1.0
_COAST_S: Final = (0.25, 2.0)
_COAST_STEPS: Final = 2.5
# How much a new detection moves the probability and the visible rows of a track.
_PROBABILITY_GAIN, _ROWS_GAIN = 0.4, 0.3
# How quickly the scale of a track's noise and the activity of the road follow larger and smaller innovations than
# expected, and the limits of both. A normalized innovation squared counts up to the last value.
_SCALE_GAINS: Final = (0.06, 0.06)
SCALES: Final = (0.125, 5.0)
ACTIVITY_GAINS: Final = (0.12, 0.12)
ACTIVITIES: Final = (0.02, 4.0)
MOST_SURPRISE: Final = 4.0
# A boundary that is so surprising for so many frames in a row is elsewhere than the filter believes.
_SURPRISING: Final = 3.0
_SURPRISING_FRAMES: Final = 3
# With less visible paint than this share of the usual, a detection follows the road rather than a marking. The usual
# share of rows with paint counts up to the second value, and follows that of detections at the third rate.
_INFERRED_SHARE, _MOST_PAINT, _PAINT_GAIN = 0.4, 0.25, 0.1
# The noise of such a detection is larger by this factor of its variance.
_INFERRED_NOISE: Final = 4.0
# The variance of errors that last, by state; however quiet a track is, it has at least this share of that.
_BIAS_SCALES: Final[Mapping[TrackState, float]] = {"detected": 1.0, "inferred": 4.0, "predicted": 9.0}
_LEAST_BIAS: Final = 0.3


def adapted(scale: float, surprise: float, gains: tuple[float, float], limits: tuple[float, float]) -> float:
    """Returns the `scale` of a variance after an innovation with this normalized square per degree of freedom.

    That is 1 on average if the variance is right. `gains` are those of larger and of smaller ones.
    """
    excess = min(surprise, MOST_SURPRISE) - 1.0
    least, most = limits
    return min(most, max(least, scale * math.exp(gains[excess < 0.0] * excess)))


@dataclass
class Track:
    """A tracked boundary; the road filter has its place. Times are seconds on the tracker's own clock.

    `hits` records for the last frames whether a detection supported it. `side` is -1 left and +1 right of the vehicle;
    `place` is where it was in the last frame, in row offsets from the vehicle's middle, and `crossed` the time at which
    that last changed its sign. `scale` multiplies the noise of its detections: they are more exact on clear paint.
    `paint` is the usual share of its rows in which a marking is visible, and `surprising` counts the detections in a
    row that were far from where it was expected. `appearance` is what its detections have shown it to be by `last_hit`.
    """

    born: float
    last_hit: float
    probability: float
    top: float
    bottom: float
    side: int
    place: float
    track_id: int | None = None
    state: TrackState = "detected"
    crossed: float = 0.0
    scale: float = 1.0
    paint: float = 0.0
    surprising: int = 0
    appearance: Appearance = Appearance()
    hits: deque[bool] = field(default_factory=lambda: deque(maxlen=FRAMES))

    @classmethod
    def begun(cls, detection: Detection, place: float, now: float) -> Track:
        """Returns the track of a new boundary, which `detection` is about to support."""
        side = 1 if place >= 0.0 else -1
        return cls(
            now,
            now,
            detection.probability,
            detection.top,
            detection.bottom,
            side,
            place,
            paint=min(detection.paint, _MOST_PAINT),
            appearance=accumulated(Appearance(), detection.appearance, math.inf, _paint_share(detection)),
        )

    @property
    def confirmed(self) -> bool:
        """Whether it has an identity."""
        return self.track_id is not None

    @property
    def has_enough_hits(self) -> bool:
        """Whether detections have supported it often enough to be confirmed."""
        return sum(self.hits) >= HITS

    @property
    def is_elsewhere(self) -> bool:
        """Whether its detections contradict the filter, which takes little from outliers."""
        return self.surprising >= _SURPRISING_FRAMES

    def coasting_s(self, step: float) -> float:
        """Returns for how many seconds it is kept without a detection, with a frame every `step` seconds."""
        shortest, longest = _COAST_S
        return min(longest, max(shortest, _COAST_STEPS * step, _COAST_SHARE * (self.last_hit - self.born)))

    def noise_scale(self, detection: Detection) -> float:
        """Returns the factor of the noise of a detection that supports it."""
        return self.scale * (_INFERRED_NOISE if self._is_inferred(detection) else 1.0)

    @property
    def bias_scale(self) -> float:
        """The factor of the variance of errors that last."""
        return max(self.scale, _LEAST_BIAS) * _BIAS_SCALES[self.state]

    def _is_inferred(self, detection: Detection) -> bool:
        """Returns whether a detection shows where the boundary must be, without a visible marking."""
        return detection.paint < _INFERRED_SHARE * self.paint

    def hit(self, detection: Detection, surprise: float, now: float) -> None:
        """Records the detection that the filter was updated with, and its normalized innovation squared.

        That is per degree of freedom: 1 on average if the noise has the right scale.
        """
        self.hits.append(True)
        if self._is_inferred(detection):
            self.state = "inferred"
        else:
            self.state = "detected"
            self.paint += _PAINT_GAIN * (min(detection.paint, _MOST_PAINT) - self.paint)
        self.appearance = accumulated(
            self.appearance, detection.appearance, now - self.last_hit, _paint_share(detection)
        )
        self.last_hit = now
        self.probability += _PROBABILITY_GAIN * (detection.probability - self.probability)
        self.top += _ROWS_GAIN * (detection.top - self.top)
        self.bottom += _ROWS_GAIN * (detection.bottom - self.bottom)
        self.surprising = self.surprising + 1 if surprise >= _SURPRISING else 0
        if len(self.hits) > HITS:
            self.scale = adapted(self.scale, surprise, _SCALE_GAINS, SCALES)

    def miss(self) -> None:
        """Records a frame without a detection."""
        self.hits.append(False)
        self.state = "predicted"

    def round(self) -> None:
        """Rounds what is saved in single or half precision, so that a restored track continues exactly."""
        for name in SINGLE_PRECISION:
            setattr(self, name, float(np.float32(getattr(self, name))))
        self.appearance = as_saved(self.appearance)

    def take_over(self, other: Track) -> None:
        """Continues with the place and the support of `other`, which follows the same boundary."""
        # What the detections of the other track have shown counts as one more detection.
        self.appearance = accumulated(self.appearance, other.appearance, max(0.0, other.last_hit - self.last_hit), 1.0)
        self.last_hit, self.state, self.hits, self.scale = other.last_hit, other.state, other.hits, other.scale
        self.top, self.bottom, self.probability = other.top, other.bottom, other.probability

    def fading(self, now: float) -> float:
        """Returns the factor of its probability, which falls with the time since its last detection."""
        return 1.0 - 0.5 * min(1.0, (now - self.last_hit) / _COAST_S[1])

    def appearance_at(self, now: float) -> Appearance:
        """Returns what is known at the time `now` of what it is."""
        return forgotten(self.appearance, now - self.last_hit)

    def is_alive(self, now: float, step: float) -> bool:
        """Whether it can still be confirmed, or coasts."""
        is_tentative = not self.confirmed and len(self.hits) - sum(self.hits) <= FRAMES - HITS
        return (self.confirmed or is_tentative) and now - self.last_hit <= self.coasting_s(step)


def _paint_share(detection: Detection) -> float:
    """Returns how much of a marking a detection shows: 1 from the usual paint of a dashed marking on."""
    return min(detection.paint / _MOST_PAINT, 1.0)
