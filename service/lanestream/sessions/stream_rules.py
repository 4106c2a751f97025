"""The rules of one stream, without its socket: who may say what when, which frame is next, and the final count.

Nothing here waits, reads a clock or knows of asyncio, so that every rule can be tested as a plain call.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from lanestream.errors import OverrunError, ProtocolError
from lanestream.protocol import FrameMessage, Mode, StartMessage, SummaryMessage


@dataclass(frozen=True)
class IncomingFrame:
    """A frame as it came: its number, its capture time in seconds, the image file, when it came (monotonic seconds)."""

    seq: int
    timestamp: float
    data: bytes
    arrived: float


class StreamRules:
    """One stream from its opening to its summary; `now` is always the time on one monotonic clock, in seconds.

    In mode `latest` one frame waits at most, and a newer one takes its place. In mode `all` up to `most_unanswered`
    frames may be unanswered at a time, none is dropped, and one more is an error.
    """

    def __init__(self, most_unanswered: int, now: float) -> None:
        self._most_unanswered = most_unanswered
        self._opened_at = now
        self._options: StartMessage | None = None
        self._announced: FrameMessage | None = None
        self._waiting: deque[IncomingFrame] = deque()
        self._busy = False
        self._ended = False
        self._next_seq = 0
        self._received = self._answered = self._failed = self._dropped = 0

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
        """Frames that were superseded before their turn came."""
        return self._dropped

    @property
    def finished(self) -> bool:
        """Whether the client ended the stream and every frame was answered."""
        return self._ended and not self._waiting and not self._busy

    def start(self, message: StartMessage) -> None:
        """The client opens the stream. Raises ProtocolError where it is open already."""
        self._refuse_after_end("start")
        if self.is_open:
            raise ProtocolError("the stream is open already", "`start` comes once, before the first frame")
        self._options = message

    def announce(self, message: FrameMessage) -> None:
        """The client numbers the binary message that follows; of two announcements in a row the later one counts."""
        self._refuse_after_end("frame")
        self._announced = message

    def receive(self, data: bytes, now: float) -> None:
        """A frame comes, and opens the stream where nothing did before.

        Raises OverrunError in mode `all` where no credit was left for it, and ProtocolError after `end`.
        """
        self._refuse_after_end("an image")
        self._options = self.options
        unanswered = len(self._waiting) + self._busy
        if self.mode == "all" and unanswered >= self._most_unanswered:
            raise OverrunError(
                f"{unanswered} frames are unanswered and one more came",
                f"mode `all` grants {self._most_unanswered} of them; wait for answers, or use mode `latest`",
            )
        if self.mode == "latest":
            self._drop_waiting()
        self._waiting.append(self._numbered(data, now))
        self._received += 1

    def end(self) -> None:
        """The client has no more frames."""
        self._refuse_after_end("end")
        self._ended = True

    def take(self) -> IncomingFrame | None:
        """The frame whose turn it is; None while another is being worked on, or where none waits."""
        if self._busy or not self._waiting:
            return None
        self._busy = True
        return self._waiting.popleft()

    def settle(self, *, answered: bool) -> None:
        """The frame that was taken is answered, or has failed. Comes before the reply, which renews the credit."""
        self._busy = False
        if answered:
            self._answered += 1
        else:
            self._failed += 1

    def summary(self, now: float) -> SummaryMessage:
        """The count of all frames so far."""
        return SummaryMessage(
            frames=self._received,
            answered=self._answered,
            failed=self._failed,
            dropped=self._dropped,
            duration_s=round(now - self._opened_at, 3),
        )

    def _drop_waiting(self) -> None:
        """Makes place for a newer frame. A frame whose turn has come stays, whether or not it was taken already."""
        turn = 0 if self._busy else 1
        while len(self._waiting) > turn:
            self._waiting.pop()
            self._dropped += 1

    def _numbered(self, data: bytes, now: float) -> IncomingFrame:
        announced = self._announced or FrameMessage()
        self._announced = None
        seq = self._next_seq if announced.seq is None else announced.seq
        timestamp = now - self._opened_at if announced.timestamp is None else announced.timestamp
        self._next_seq = seq + 1
        return IncomingFrame(seq, timestamp, data, now)

    def _refuse_after_end(self, what: str) -> None:
        if self._ended:
            raise ProtocolError(f"{what} came after `end`", "`end` is the last message of a stream")
