"""Reads live cameras: opens them again when they are lost, and gives their frames capture times."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from typing import Final, Self

from lanestream.errors import CameraLostError
from lanestream_client.capture_clock import CaptureClock
from lanestream_client.failover import RetryPolicy
from lanestream_client.frames import SourceCounts, SourceFrame
from lanestream_client.video_decoding import DecodedFrame, VideoError

# A camera that is lost again before this time is opened again with growing pauses, as if it had not come back.
_STEADY_S: Final = 10.0
_FIRST_PAUSE_S: Final = 0.5
_LONGEST_PAUSE_S: Final = 5.0


@dataclass(frozen=True)
class Feed:
    """An open camera. Its `frames` end, or raise VideoError, when it is lost; `has_times` says if they have a time."""

    frames: Iterator[DecodedFrame]
    fps: float
    has_times: bool
    close: Callable[[], None]


class LiveSource:
    """The frames of a camera, across outages, until `stop` is called.

    When the camera is lost, `reopen` is called with growing pauses for up to `reconnect_s` seconds; it raises
    VideoError if the camera can't be opened yet. `notify` gets a line of text about each outage and its end. Iterating
    raises CameraLostError when the camera did not come back.
    """

    def __init__(
        self,
        name: str,
        feed: Feed,
        reopen: Callable[[], Feed],
        *,
        reconnect_s: float,
        counts: SourceCounts,
        notify: Callable[[str], None],
    ) -> None:
        self._name = name
        self._first_feed = feed
        self._reopen = reopen
        self._policy = RetryPolicy(reconnect_s, first_pause_s=_FIRST_PAUSE_S, max_pause_s=_LONGEST_PAUSE_S)
        self._counts = counts
        self._notify = notify
        self._clock = CaptureClock(1.0 / feed.fps, has_times=feed.has_times)
        self._stopped = threading.Event()
        self._attempts = 0  # to open the camera again, since it last worked for a while
        self._last_frame = time.monotonic()
        self._lost_at: float | None = None  # when the present outage was noticed
        self._reason = ""  # of the present outage
        self._frames = self._read(feed)

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> SourceFrame:
        return next(self._frames)

    def stop(self) -> None:
        """Ends the iteration, also from another thread: at once while the camera is lost, else at its next frame."""
        self._stopped.set()

    def close(self) -> None:
        """Closes the camera. A thread that still waits for it closes it when its wait ends."""
        self.stop()
        try:
            self._frames.close()
        except ValueError:
            return
        self._first_feed.close()  # the generator closes it only once it has started

    def _read(self, feed: Feed | None) -> Generator[SourceFrame]:
        seq = 0
        while feed is not None:
            reason = "closed the stream"
            try:
                for frame in self._frames_of(feed, seq):
                    seq += 1
                    yield frame
            except VideoError as error:
                reason = str(error)
            finally:
                feed.close()
            feed = None if self._stopped.is_set() else self._open_again(reason)

    def _frames_of(self, feed: Feed, seq: int) -> Iterator[SourceFrame]:
        """Yields the frames of one connection, numbered from `seq`."""
        # Frames may have waited since the camera was opened, all of which come now.
        began = time.monotonic()
        for number, decoded in enumerate(feed.frames, seq):
            if self._stopped.is_set():
                return
            arrived = max(began, decoded.arrived)
            if self._lost_at is not None:
                self._report_return(arrived)
                self._clock.reconnected(has_times=feed.has_times)
            if arrived - began > _STEADY_S:
                self._attempts = 0
            self._last_frame = arrived
            timestamp, clock = self._clock.time(decoded.time, requested=decoded.requested, arrived=arrived)
            yield SourceFrame(number, timestamp, pixels=decoded.pixels, clock=clock, reconnects=self._counts.reconnects)

    def _open_again(self, reason: str) -> Feed | None:
        """Returns the camera when it is back, or None if the iteration was stopped. Raises CameraLostError."""
        total_s = self._policy.total_s
        if self._lost_at is None:
            self._lost_at, self._reason = time.monotonic(), reason
            if total_s:
                self._notify(f"{self._name} {reason}; opening it again, for up to {total_s:g} s")
        while True:
            pause = self._policy.pause_s(self._attempts, jitter=1.0)
            self._attempts += 1
            if time.monotonic() + pause >= self._lost_at + total_s:
                raise self._lost_error(reason)
            if self._stopped.wait(pause):
                return None
            try:
                return self._reopen()
            except VideoError as error:
                reason = str(error)

    def _lost_error(self, reason: str) -> CameraLostError:
        if not self._policy.total_s:
            return CameraLostError(f"{self._name} {self._reason}", "with --reconnect-camera it would be opened again")
        last = "" if reason == self._reason else f": {reason}"
        return CameraLostError(
            f"{self._name} {self._reason} and did not come back within {self._policy.total_s:g} s{last}",
            "check the camera and the network, or wait longer with --reconnect-camera",
        )

    def _report_return(self, arrived: float) -> None:
        self._lost_at = None
        outage_s = arrived - self._last_frame
        self._counts.reconnects += 1
        self._counts.outage_s += outage_s
        self._notify(f"{self._name} is back after {outage_s:.1f} s without frames")
