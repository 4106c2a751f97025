"""Gives each frame of a live camera its capture time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from lanestream_client.frames import Clock

# A camera's clock that jumps back, or forward by more than this, was set anew.
_LONGEST_JUMP_S: Final = 10.0
# Capture times rise, also if several frames arrive at once.
_SHORTEST_STEP_S: Final = 0.001
# FFmpeg gives a few frames of many cameras no time. That many in a row continue at the pace before them.
_MOST_UNTIMED: Final = 3
# A camera's clock is compared with the arrival of its frames over windows of this length. One window may hold a burst
# of frames that waited in the camera or in the network; several in a row that disagree show that the clock is wrong.
_WINDOW_S: Final = 2.0
_WRONG_WINDOWS: Final = 3
_LARGEST_RATIO: Final = 1.5
# Frames that waited for their reader say nothing about the pace of the camera.
_SMALLEST_WAITING_SHARE: Final = 0.5


class CaptureClock:
    """Turns the times of a live camera into rising seconds since its first frame, also across reconnections.

    The camera's own times are used if it has them and they keep the pace of arrivals, else the times at which frames
    arrived. `period` is the time between two frames in seconds, for a frame without a time of its own.
    """

    def __init__(self, period: float, *, has_times: bool) -> None:
        self._period = period
        self._has_times = has_times
        self._last = 0.0  # the latest capture time
        self._last_arrival: float | None = None
        self._offset: float | None = None  # from the camera's times to capture times
        self._arrival_offset: float | None = None  # from arrivals to capture times, while these are used
        self._step = 0.0  # between the latest two times of the camera
        self._untimed = 0  # frames since the latest time of the camera
        self._window: tuple[float, float] | None = None  # arrival and camera's time at its start
        self._waited = 0.0  # in this window
        self._wrong_windows = 0

    def reconnected(self, *, has_times: bool) -> None:
        """Records that the next frame comes from a new connection, whose times start anew."""
        self._has_times = has_times
        self._offset = None
        self._step = 0.0
        self._window = None
        self._wrong_windows = 0

    def time(self, source: float | None, *, requested: float, arrived: float) -> tuple[float, Clock]:
        """Returns the capture time of the next frame in seconds, and the clock that it is from.

        `source` is the camera's time. `requested` and `arrived` say, on one clock of this machine, when the reader
        began to wait for the frame and when it came.
        """
        passed = 0.0
        if self._last_arrival is not None:
            passed = max(arrived - self._last_arrival, _SHORTEST_STEP_S)
        self._last_arrival = arrived
        if source is not None and self._has_times:
            self._check_pace(source, requested, arrived)
        if source is None and self._has_times and self._step and self._untimed < _MOST_UNTIMED:
            self._untimed += 1
            self._last += self._step
            return self._last, "source"
        if source is None or not self._has_times:
            return self._arrival_time(arrived, passed), "arrival"
        self._untimed = 0
        if self._offset is None:
            # The frame before it may have come without a time, in one burst with this one.
            self._last += max(passed, self._period) if passed else 0.0
            self._offset, self._arrival_offset = self._last - source, None
            return self._last, "source"
        step = source + self._offset - self._last
        if 0.0 < step <= passed + _LONGEST_JUMP_S:
            self._last, self._step, self._arrival_offset = self._last + step, step, None
            return self._last, "source"
        self._offset = self._arrival_time(arrived, passed) - source
        return self._last, "arrival"

    def _arrival_time(self, arrived: float, passed: float) -> float:
        """Moves on by the time that passed between arrivals, without drift over many frames."""
        if self._arrival_offset is None:
            self._arrival_offset = self._last + passed - arrived
            self._last += passed
        else:
            self._last = max(arrived + self._arrival_offset, self._last + _SHORTEST_STEP_S)
        return self._last

    def _check_pace(self, source: float, requested: float, arrived: float) -> None:
        """Stops using a camera's clock that runs at another pace than its frames arrive."""
        if self._window is None:
            self._window, self._waited = (arrived, source), 0.0
            return
        self._waited += max(0.0, arrived - requested)
        started, source_started = self._window
        length = arrived - started
        if length < _WINDOW_S:
            return
        self._window = (arrived, source)
        waited, self._waited = self._waited, 0.0
        if waited < _SMALLEST_WAITING_SHARE * length:
            return
        ratio = (source - source_started) / length
        self._wrong_windows = 0 if 1.0 / _LARGEST_RATIO <= ratio <= _LARGEST_RATIO else self._wrong_windows + 1
        if self._wrong_windows == _WRONG_WINDOWS:
            self._has_times = False
