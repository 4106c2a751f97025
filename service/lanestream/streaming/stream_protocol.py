"""The rules of one stream, without its socket: who may say what when, which frame is next, and the final count.

Nothing here waits, reads a clock or knows of asyncio, so that every rule can be tested as a plain call. `now` is always
the time on one monotonic clock, in seconds.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum, auto

from lanestream.errors import (
    DrainingError,
    IdleError,
    LanestreamError,
    OverrunError,
    ProtocolError,
    RateError,
    TooOldError,
)
from lanestream.protocol import FrameMessage, Mode, StartMessage, SummaryMessage


@dataclass(frozen=True)
class StreamLimits:
    """What a stream may do.

    In mode `all` up to `credits` frames may be unanswered at a time. `frames_per_s` and `bytes_per_s` hold on average
    over `burst_s` seconds. In mode `latest` a frame expires after `frame_deadline_s`. The first message comes within
    `handshake_s`, and nothing is ever longer away than `idle_s`.
    """

    credits: int = 8
    frames_per_s: float = 240.0
    bytes_per_s: float = 256e6
    burst_s: float = 2.0
    frame_deadline_s: float = 2.0
    handshake_s: float = 10.0
    idle_s: float = 60.0


@dataclass(frozen=True)
class IncomingFrame:
    """A frame as it came: its number, its capture time in seconds, the image file, when it came (monotonic seconds).

    After `deadline` its lanes are of no use. One with a `refusal` is answered with that, and its image is forgotten.
    """

    seq: int
    timestamp: float
    data: bytes
    arrived: float
    deadline: float | None = None
    refusal: LanestreamError | None = None


class Outcome(Enum):
    """What became of a frame whose turn had come."""

    ANSWERED = auto()
    FAILED = auto()
    EXPIRED = auto()


class TokenBucket:
    """A token bucket: `rate` units a second on average, and what `burst_s` seconds bring at once."""

    def __init__(self, rate: float, burst_s: float, now: float) -> None:
        self._rate = rate
        self._most = max(rate * burst_s, 1.0)
        self._left = self._most
        self._at = now

    def covers(self, amount: float, now: float) -> bool:
        """Whether `amount` is left. One that is larger than any burst waits for a full bucket."""
        self._left = min(self._most, self._left + self._rate * (now - self._at))
        self._at = now
        return self._left >= min(amount, self._most)

    def spend(self, amount: float) -> None:
        """Takes `amount` out, if need be beyond the bottom."""
        self._left -= amount


class StreamProtocol:
    """One stream from its opening to its end.

    In mode `latest` one frame waits at most, and a newer one takes its place. In mode `all` none is dropped, and one
    more than is granted is an error. Every frame that comes is answered, refused or counted as dropped.
    """

    def __init__(self, limits: StreamLimits, now: float) -> None:
        self._limits = limits
        self._accepted_at = now
        self._clock_zero = now
        self._heard_at: float | None = None
        self._options: StartMessage | None = None
        self._announced: FrameMessage | None = None
        self._waiting: deque[IncomingFrame] = deque()
        self._busy = False
        self._queued = False
        self._ended = False
        self._draining = False
        self._over = False
        self._next_seq = 0
        self._received = self._answered = self._failed = self._dropped = 0
        self._frames = TokenBucket(limits.frames_per_s, limits.burst_s, now)
        self._bytes = TokenBucket(limits.bytes_per_s, limits.burst_s, now)

    @property
    def options(self) -> StartMessage:
        """What the client opened the stream with, or the defaults."""
        return self._options or StartMessage()

    @property
    def mode(self) -> Mode:
        """What happens to frames that come faster than they are answered."""
        return self.options.mode

    @property
    def is_open(self) -> bool:
        """Whether the stream was opened, by a `start` or by a first frame."""
        return self._options is not None

    @property
    def dropped(self) -> int:
        """Frames that got no lanes because newer ones came, or because they had waited too long."""
        return self._dropped

    @property
    def has_waiting(self) -> bool:
        """Whether a frame waits for its turn."""
        return bool(self._waiting) and not self._busy

    @property
    def ended(self) -> bool:
        """Whether the client has said that no more frames come."""
        return self._ended

    @property
    def over(self) -> bool:
        """Whether the last answers are given, so that what comes is too late."""
        return self._over

    @property
    def finished(self) -> bool:
        """Whether the stream is at its end, by the client's `end` or by draining, and every frame was answered."""
        if self._busy:
            return False
        if self._draining and not self._ended:
            return all(frame.refusal is not None for frame in self._waiting)
        return self._ended and not self._waiting

    def start(self, message: StartMessage, now: float) -> None:
        """The client opens the stream. Raises ProtocolError where it is open already."""
        self._hear("start", now)
        if self.is_open:
            raise ProtocolError("the stream is open already", "`start` comes once, before the first frame")
        self._options = message

    def go_on(self, last_seq: int | None, stream_s: float, now: float) -> None:
        """The stream goes on where another socket's ended: after `last_seq`, `stream_s` seconds on its clock."""
        self._next_seq = 0 if last_seq is None else last_seq + 1
        self._clock_zero = now - stream_s

    def stream_s(self, now: float) -> float:
        """The stream's own clock, which tells the time of frames that have none."""
        return now - self._clock_zero

    def announce(self, message: FrameMessage, now: float) -> None:
        """The client numbers the binary message that follows; of two announcements in a row the later one counts."""
        self._hear("frame", now)
        self._announced = message

    def receive(self, data: bytes, now: float) -> int:
        """A frame comes, and opens the stream where nothing did before; how many waiting ones it took the place of.

        After `rest` it is not taken. Raises OverrunError in mode `all` where no credit was left for it, and
        ProtocolError after `end`.
        """
        self._hear("an image", now)
        self._options = self.options
        if self._over:
            return 0
        unanswered = len(self._waiting) + self._busy
        if self.mode == "all" and unanswered >= self._limits.credits:
            raise OverrunError(
                f"{unanswered} frames are unanswered and one more came",
                f"mode `all` grants {self._limits.credits} of them; wait for answers, or use mode `latest`",
            )
        refusal = self._refusal(len(data), now)
        dropped = self._drop_waiting(refusal is not None) if self.mode == "latest" else 0
        self._waiting.append(self._numbered(data, now, refusal))
        self._received += 1
        return dropped

    def end(self, now: float) -> None:
        """The client has no more frames."""
        self._hear("end", now)
        self._ended = True

    def drain(self) -> None:
        """The service is about to stop: what has come is answered, what comes from now on is refused."""
        self._draining = True

    def queue(self, waits: bool) -> None:
        """Tells whether the frame whose turn it is waits for frames of others; a newer one may then replace it."""
        self._queued = waits

    def take(self) -> IncomingFrame | None:
        """The frame whose turn it is; None while another is being worked on, or where none waits."""
        if self._busy or not self._waiting:
            return None
        self._busy = True
        return self._waiting.popleft()

    def rest(self) -> list[IncomingFrame]:
        """What waits when the stream is finished: refused frames, whose answers are due. What comes now is too late."""
        rest, self._waiting = list(self._waiting), deque()
        self._failed += len(rest)
        self._over = True
        return rest

    def settle(self, outcome: Outcome, now: float) -> None:
        """The frame that was taken has come to its `outcome`. Comes before the reply, which renews the credit."""
        self._busy = False
        self._heard_at = now
        self._answered += outcome is Outcome.ANSWERED
        self._failed += outcome is Outcome.FAILED
        self._dropped += outcome is Outcome.EXPIRED

    def silence_left(self, now: float) -> float:
        """Seconds until the stream has been silent for too long; work in progress is no silence."""
        if self._heard_at is None:
            return self._accepted_at + self._limits.handshake_s - now
        if self._busy or self._waiting:
            return self._limits.idle_s
        return self._heard_at + self._limits.idle_s - now

    def check_silence(self, now: float) -> None:
        """Raises IdleError where nothing came for too long."""
        if self.silence_left(now) <= 0.0:
            most = self._limits.handshake_s if self._heard_at is None else self._limits.idle_s
            raise IdleError(f"nothing came for {most:g} seconds", "open the stream again when there are frames")

    def summary(self, now: float) -> SummaryMessage:
        """The count of all frames so far."""
        return SummaryMessage(
            frames=self._received,
            answered=self._answered,
            failed=self._failed,
            dropped=self._dropped,
            duration_s=round(now - self._accepted_at, 3),
        )

    def _refusal(self, size: int, now: float) -> LanestreamError | None:
        """Why a frame of `size` bytes is not taken; None where it is."""
        if self._draining:
            return DrainingError("the service is about to stop", "resume the session on another replica")
        limits = self._limits
        if not self._frames.covers(1.0, now):
            return RateError(f"more than {limits.frames_per_s:g} frames a second came", "send fewer")
        if not self._bytes.covers(size, now):
            return RateError(f"more than {limits.bytes_per_s:,.0f} bytes a second came", "send smaller images")
        self._frames.spend(1.0)
        self._bytes.spend(size)
        return None

    def _drop_waiting(self, refused: bool) -> int:
        """Makes place for a newer frame. A frame whose turn has come stays, whether or not it was taken already.

        One that is `refused` takes no other's place than that of refused ones.
        """
        turn = 0 if self._busy or self._queued else 1
        before = len(self._waiting)
        while len(self._waiting) > turn and (not refused or self._waiting[-1].refusal is not None):
            self._waiting.pop()
        self._dropped += before - len(self._waiting)
        return before - len(self._waiting)

    def _numbered(self, data: bytes, now: float, refusal: LanestreamError | None) -> IncomingFrame:
        announced = self._announced or FrameMessage()
        self._announced = None
        seq = self._next_seq if announced.seq is None else announced.seq
        timestamp = self.stream_s(now) if announced.timestamp is None else announced.timestamp
        self._next_seq = seq + 1
        deadline = now + self._limits.frame_deadline_s if self.mode == "latest" else None
        return IncomingFrame(seq, timestamp, b"" if refusal else data, now, deadline, refusal)

    def _hear(self, what: str, now: float) -> None:
        self._heard_at = now
        if self._ended:
            raise ProtocolError(f"{what} came after `end`", "`end` is the last message of a stream")


def check_age(age_s: float, most_s: float) -> None:
    """Raises TooOldError where a session has lived longer than `most_s` seconds."""
    if age_s >= most_s:
        raise TooOldError(f"the session is {age_s:.0f} seconds old, which is the most", "open a new one")
