"""The rules of one stream without its socket (sans-I/O): what is allowed when, which frame is next, the counts.

Nothing here waits, reads a clock or imports asyncio, so every rule can be tested with plain calls. `now` is always a
time on one monotonic clock, in seconds.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum, auto

from lanestream.errors import DrainingError, IdleError, LanestreamError, OverrunError, ProtocolError, RateError
from lanestream.protocol import (
    DrainingMessage,
    EndMessage,
    FrameMessage,
    Mode,
    ServerMessage,
    StartMessage,
    SummaryMessage,
    WarningCode,
    error_message,
    warning_message,
)
from lanestream.streaming.token_bucket import TokenBucket
from lanestream.tracking.departure import VehicleMotion


@dataclass(frozen=True)
class StreamLimits:
    """The limits of one stream.

    In mode `all`, up to `credits` frames may be unanswered at a time. `frames_per_s` and `bytes_per_s` are averages
    over `burst_s` seconds. In mode `latest`, a frame expires `frame_deadline_s` seconds after its arrival. The first
    message must arrive within `handshake_s` seconds, every later one within `idle_s` seconds of the previous activity.
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
    """A received frame: its number, capture time in seconds, image file and arrival time (monotonic seconds).

    After `deadline` its lanes are no longer useful. A frame with a `refusal` is answered with that error, and its image
    is discarded. `motion` is what the vehicle reported with it.
    """

    seq: int
    timestamp: float
    data: bytes
    arrived: float
    deadline: float | None = None
    refusal: LanestreamError | None = None
    motion: VehicleMotion = VehicleMotion()


class StreamState(Enum):
    """The life of a stream.

    `start` or a first image opens it. The client's `end` moves every state to ENDING, a stop of the service moves
    CONNECTING and OPEN to DRAINING. `StreamProtocol.finish` turns ENDING into ENDED, and DRAINING into DRAINED.
    """

    CONNECTING = auto()
    """The socket is open, and neither `start` nor an image has arrived."""
    OPEN = auto()
    """Frames are accepted."""
    ENDING = auto()
    """The client sent `end`. The frames held are still answered; any further message is an error."""
    ENDED = auto()
    """Every frame was answered after `end`."""
    DRAINING = auto()
    """The service is about to stop. The frames held are still answered; further ones are refused."""
    DRAINED = auto()
    """Every frame that arrived before the drain was answered. Images that still arrive are ignored."""


class FrameOutcome(Enum):
    """The result of processing a frame."""

    ANSWERED = auto()
    FAILED = auto()
    EXPIRED = auto()


class StreamProtocol:
    """The server side of one stream, from its first message to its last.

    In mode `latest` at most one frame waits, and a newer one replaces it. In mode `all` no frame is dropped, and a
    frame beyond the credits is an error. Every frame is answered, refused or counted as dropped.
    """

    def __init__(self, limits: StreamLimits, now: float) -> None:
        self._limits = limits
        self._state = StreamState.CONNECTING
        self._options = StartMessage()
        self._connected_at = now
        self._stream_began_at = now
        self._last_activity: float | None = None
        self._announced: FrameMessage | None = None
        self._waiting: deque[IncomingFrame] = deque()
        self._current: IncomingFrame | None = None
        self._slot_requested = False
        self._outgoing: list[ServerMessage] = []
        self._next_seq = 0
        self._received = self._answered = self._failed = self._dropped = 0
        self._frame_budget = TokenBucket(limits.frames_per_s, limits.burst_s, now)
        self._byte_budget = TokenBucket(limits.bytes_per_s, limits.burst_s, now)

    @property
    def state(self) -> StreamState:
        """The current state."""
        return self._state

    @property
    def options(self) -> StartMessage:
        """The `start` message of the client, or its defaults."""
        return self._options

    @property
    def mode(self) -> Mode:
        """What happens to frames that arrive faster than they are answered."""
        return self._options.mode

    @property
    def answered(self) -> int:
        """Frames that were answered with lanes."""
        return self._answered

    @property
    def dropped(self) -> int:
        """Frames without an answer, because a newer one replaced them or because they expired."""
        return self._dropped

    @property
    def has_waiting_frame(self) -> bool:
        """Whether `take_frame` would return a frame."""
        return bool(self._waiting) and self._current is None

    @property
    def held_bytes(self) -> int:
        """The bytes of the images that are not answered yet."""
        current = 0 if self._current is None else len(self._current.data)
        return current + sum(len(frame.data) for frame in self._waiting)

    @property
    def ended_by_client(self) -> bool:
        """Whether the client sent `end`."""
        return self._state in (StreamState.ENDING, StreamState.ENDED)

    @property
    def finished(self) -> bool:
        """Whether the client or the service ended the stream, and every accepted frame was answered."""
        if self._current is not None:
            return False
        if self._state is StreamState.DRAINING:
            return all(frame.refusal is not None for frame in self._waiting)
        if self._state is StreamState.ENDING:
            return not self._waiting
        return self._state in (StreamState.ENDED, StreamState.DRAINED)

    def receive_start(self, message: StartMessage, now: float) -> None:
        """Opens the stream. Raises ProtocolError unless it is the first message besides `frame`."""
        self._note_activity("`start`", now)
        if self._state is not StreamState.CONNECTING:
            raise ProtocolError(
                f"`start` came in a stream that is already {self._state.name.lower()}",
                "send `start` once, before the first image",
            )
        self._options = message
        self._state = StreamState.OPEN

    def resume(self, last_seq: int | None, stream_s: float, now: float) -> None:
        """Continues a resumed session: numbers after `last_seq`, and the stream's clock at `stream_s` seconds."""
        self._next_seq = 0 if last_seq is None else last_seq + 1
        self._stream_began_at = now - stream_s

    def receive_message(self, message: FrameMessage | EndMessage, now: float) -> None:
        """Handles every text message except `start`; replies go to `messages_to_send`.

        Raises ProtocolError after `end`. Of two `frame` messages in a row the later one applies.
        """
        self._note_activity(f"`{message.type}`", now)
        match message:
            case FrameMessage():
                self._announced = message
            case EndMessage():
                self._state = StreamState.ENDING

    def receive_image(self, data: bytes, now: float, refusal: LanestreamError | None = None) -> int:
        """Accepts or refuses a frame and returns how many waiting frames it replaced. A first image opens the stream.

        `refusal` is an error by which it is refused in any case.
        Raises OverrunError in mode `all` if no credit is left, and ProtocolError after `end`.
        """
        self._note_activity("an image", now)
        if self._state is StreamState.DRAINED:
            return 0
        if self._state is StreamState.CONNECTING:
            self._state = StreamState.OPEN
        unanswered = len(self._waiting) + (self._current is not None)
        if self.mode == "all" and unanswered >= self._limits.credits:
            raise OverrunError(
                f"another frame came while {unanswered} frames were unanswered",
                f"mode `all` allows {self._limits.credits} unanswered frames; wait for answers, or use mode `latest`",
            )
        refusal = refusal or self._refusal(len(data), now)
        replaced = self._replace_waiting(refused=refusal is not None) if self.mode == "latest" else 0
        self._waiting.append(self._numbered(data, now, refusal))
        self._received += 1
        return replaced

    def messages_to_send(self) -> list[ServerMessage]:
        """Returns the messages that are due to the client, each of them once."""
        messages, self._outgoing = self._outgoing, []
        return messages

    def drain(self, resume_token: str | None, deadline_s: float) -> None:
        """Announces that the service is about to stop: the frames held are answered, later ones are refused."""
        if self._state in (StreamState.CONNECTING, StreamState.OPEN):
            self._state = StreamState.DRAINING
        self._outgoing.append(DrainingMessage(resume_token=resume_token, deadline_s=deadline_s))

    def warn(self, code: WarningCode, seq: int) -> None:
        """Warns the client of something that the frame `seq` showed."""
        self._outgoing.append(warning_message(code, seq))

    def request_slot(self) -> None:
        """Notes that the next frame waits for other streams; until `take_frame` a newer frame may replace it."""
        self._slot_requested = True

    def take_frame(self) -> IncomingFrame | None:
        """Returns the next frame; None if another one is being processed, or if none waits."""
        self._slot_requested = False
        if not self.has_waiting_frame:
            return None
        self._current = self._waiting.popleft()
        return self._current

    def complete_frame(self, outcome: FrameOutcome, now: float) -> None:
        """Counts the frame that was taken. Call it before sending the reply, which renews the client's credit."""
        self._current = None
        self._last_activity = now
        self._answered += outcome is FrameOutcome.ANSWERED
        self._failed += outcome is FrameOutcome.FAILED
        self._dropped += outcome is FrameOutcome.EXPIRED

    def finish(self) -> None:
        """Ends a stream that is `finished`. Refused frames that still wait are answered through `messages_to_send`."""
        if not self.finished:
            raise RuntimeError(f"finish() expects a finished stream; this one is {self._state.name.lower()}")
        late, self._waiting = self._waiting, deque()
        self._failed += len(late)
        self._outgoing += [error_message(frame.refusal, seq=frame.seq) for frame in late if frame.refusal is not None]
        self._state = StreamState.ENDED if self.ended_by_client else StreamState.DRAINED

    def stream_s(self, now: float) -> float:
        """Returns the seconds since the stream began, which are the timestamps of frames without one."""
        return now - self._stream_began_at

    def idle_s_left(self, now: float) -> float:
        """Returns the seconds until the stream has been idle for too long. A frame in progress is activity."""
        if self._last_activity is None:
            return self._connected_at + self._limits.handshake_s - now
        if self._current is not None or self._waiting:
            return self._limits.idle_s
        return self._last_activity + self._limits.idle_s - now

    def check_idle(self, now: float) -> None:
        """Raises IdleError if the stream has been idle for too long."""
        if self.idle_s_left(now) <= 0.0:
            limit = self._limits.handshake_s if self._last_activity is None else self._limits.idle_s
            raise IdleError(f"no message came for {limit:g} seconds", "open the stream again when there are frames")

    def summary(self, now: float) -> SummaryMessage:
        """Returns the counts of all frames so far."""
        return SummaryMessage(
            frames=self._received,
            answered=self._answered,
            failed=self._failed,
            dropped=self._dropped,
            duration_s=round(now - self._connected_at, 3),
        )

    def _note_activity(self, received: str, now: float) -> None:
        """Restarts the idle clock. Raises ProtocolError after `end`."""
        self._last_activity = now
        if self.ended_by_client:
            raise ProtocolError(f"{received} came after `end`", "send nothing after `end`")

    def _refusal(self, size: int, now: float) -> LanestreamError | None:
        """Returns why a frame of `size` bytes is refused; None if it is accepted, which spends its budget."""
        if self._state is StreamState.DRAINING:
            return DrainingError("the service is about to stop", "resume the session on another replica")
        limits = self._limits
        if not self._frame_budget.covers(1.0, now):
            return RateError(f"more than {limits.frames_per_s:g} frames per second came", "send fewer frames")
        if not self._byte_budget.covers(size, now):
            return RateError(f"more than {limits.bytes_per_s:,.0f} bytes per second came", "send smaller images")
        self._frame_budget.spend(1.0)
        self._byte_budget.spend(size)
        return None

    def _replace_waiting(self, *, refused: bool) -> int:
        """Drops the frames that a newer one replaces, and returns their number.

        A `refused` frame replaces only refused ones. If no frame is in progress or waits for its slot, the first
        waiting frame is about to be taken and stays.
        """
        protected = 0 if self._current is not None or self._slot_requested else 1
        before = len(self._waiting)
        while len(self._waiting) > protected and (not refused or self._waiting[-1].refusal is not None):
            self._waiting.pop()
        replaced = before - len(self._waiting)
        self._dropped += replaced
        return replaced

    def _numbered(self, data: bytes, now: float, refusal: LanestreamError | None) -> IncomingFrame:
        announced = self._announced or FrameMessage()
        self._announced = None
        seq = self._next_seq if announced.seq is None else announced.seq
        timestamp = self.stream_s(now) if announced.timestamp is None else announced.timestamp
        self._next_seq = seq + 1
        deadline = now + self._limits.frame_deadline_s if self.mode == "latest" else None
        motion = VehicleMotion(announced.speed, announced.indicator)
        return IncomingFrame(seq, timestamp, b"" if refusal else data, now, deadline, refusal, motion)
