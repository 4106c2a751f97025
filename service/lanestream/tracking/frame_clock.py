"""The time between frames, from timestamps that may be wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from lanestream.road.results import TimestampWarning

# Before two frames are known, the step between frames is taken for this many seconds.
_USUAL_STEP: Final = 0.04
# How quickly the usual step follows those of a stream; a longer one counts as a gap, not as the usual step.
_STEP_GAIN, _LONGEST_STEP = 0.2, 1.0
# So many steps in a row of so many seconds look like milliseconds: nobody follows lanes in such pictures.
_MILLISECONDS: Final = (5.0, 1000.0)
_LONG_STEPS: Final = 3


@dataclass(frozen=True)
class FrameClock:
    """A clock that runs with the frames of a stream.

    `now` is in seconds since its first frame, `timestamp` that of the last frame, and `step` the usual step between
    frames. `long_steps` counts steps in a row that look like milliseconds, and `factor` converts timestamps to seconds.
    `warned` are the warnings that were given.
    """

    now: float = 0.0
    timestamp: float | None = None
    step: float = _USUAL_STEP
    long_steps: int = 0
    factor: float = 1.0
    warned: tuple[TimestampWarning, ...] = ()

    def advanced(self, timestamp: float) -> tuple[FrameClock, tuple[TimestampWarning, ...]]:
        """Returns the clock at the frame with this timestamp, and the warnings that it gives for the first time.

        If timestamps don't advance, the usual step passes. If steps look like milliseconds, they are taken for that.
        """
        if self.timestamp is None:
            return replace(self, timestamp=timestamp), ()
        seconds = timestamp - self.timestamp
        least, most = _MILLISECONDS
        long_steps = self.long_steps + 1 if least <= seconds <= most else 0
        factor = 1e-3 if long_steps >= _LONG_STEPS else self.factor
        found: list[TimestampWarning] = []
        if factor < 1.0:
            found.append("timestamps_in_milliseconds")
        if seconds <= 0.0:
            found.append("timestamps_not_advancing")
        step, passed = self.step, seconds * factor
        if passed <= 0.0:
            passed = step
        elif passed <= _LONGEST_STEP:
            step += (_STEP_GAIN if self.now else 1.0) * (passed - step)
        new = tuple(warning for warning in found if warning not in self.warned)
        return FrameClock(self.now + passed, timestamp, step, long_steps, factor, self.warned + new), new

    def timestamp_at(self, seconds: float) -> float:
        """Returns the timestamp of a time on this clock, at most `now`."""
        return (self.timestamp or 0.0) - (self.now - seconds) / self.factor
