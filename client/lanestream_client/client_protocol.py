"""The client's side of a stream without any I/O. The blocking and the async client share it.

A `ClientProtocol` keeps a few frames in flight, one by default: more would only queue in the service and make every
result older, which pays off only if the network is slower than the service.

A stream outlives its sockets: even if they break, each frame of the source gets exactly one result or is counted as
dropped. After a connection was lost, mode `latest` reports the unanswered frames as lost. Mode `all` sends them again,
except those that a resumed session has already processed: only their results are lost.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import Final, Literal

from lanestream.errors import (
    DrainingError,
    ImageTooLargeError,
    LostError,
    ProtocolError,
    SettingsError,
    error_from_code,
)
from lanestream.protocol import (
    DrainingMessage,
    EndMessage,
    ErrorMessage,
    FrameMessage,
    LanesMessage,
    ReadyMessage,
    ServerMessage,
    StartMessage,
    SummaryMessage,
    WarningMessage,
    error_message,
    parse_server_message,
)
from lanestream_client.frames import SourceFrame, StreamResult, StreamSummary
from lanestream_client.oversize import SmallerImage, fit_frame

_log: Final = logging.getLogger(__name__)

_Unanswered = Literal["dropped", "lost"]


class ClientState(Enum):
    """The states of a stream on the client's side."""

    DISCONNECTED = auto()  # no socket, or the service has not answered `start` yet
    OPEN = auto()  # frames can be sent
    ENDING = auto()  # `end` was sent; the last results and the summary are due
    FINISHED = auto()  # the summary is known


@dataclass(frozen=True)
class _PendingFrame:
    """A frame without a result: waiting to be sent, sent, or rejected by the client itself."""

    frame: SourceFrame
    data: bytes
    sent: bool = False
    rejection: ErrorMessage | None = None
    smaller: SmallerImage | None = None

    @property
    def waiting(self) -> bool:
        return not self.sent and self.rejection is None


class ClientProtocol:
    """Decides what to send, and matches the service's messages to frames.

    At most `in_flight` frames are unanswered at a time. No method blocks. Calls from several threads need a lock.
    `ready` is the service's latest answer to `start`, `reconnects` counts how often the stream was opened again,
    `is_draining` says whether the service announced over the latest socket that it is about to stop, and `summary` is
    set when the stream has finished. `warnings` are those that the service sent.
    """

    def __init__(self, start: StartMessage, *, in_flight: int = 1, clock: Callable[[], float] = time.monotonic) -> None:
        self.state = ClientState.DISCONNECTED
        self.ready: ReadyMessage | None = None
        self.summary: StreamSummary | None = None
        self.reconnects = 0
        self.is_draining = False
        self.warnings: tuple[WarningMessage, ...] = ()
        self._start = start
        self._in_flight = in_flight
        self._clock = clock
        self._started_at = 0.0
        self._pending: dict[int, _PendingFrame] = {}  # by sequence number, in ascending order
        self._last_seq = -1
        self._counts: Counter[str] = Counter()
        self._source_ended = False
        self._reported_size = False

    @property
    def wants_frame(self) -> bool:
        """Whether the next frame of the source should be read."""
        return not any(pending.waiting for pending in self._pending.values())

    def start_message(self) -> str:
        """Returns the first message for a new socket. It resumes the session of the previous socket, if any."""
        return self._start.model_dump_json(exclude_none=True)

    def receive_ready(self, text: str | bytes) -> list[StreamResult]:
        """Handles the service's answer to `start`. Returns results for the frames whose results are lost.

        Raises the error that the service sent, or ProtocolError if the answer is not `ready`.
        """
        ready = _parse(text)
        if isinstance(ready, ErrorMessage):
            raise error_from_code(ready.code, ready.message, ready.hint)
        if isinstance(ready, DrainingMessage):
            raise DrainingError("the service is about to stop")
        if not isinstance(ready, ReadyMessage):
            raise ProtocolError(f"the service answered `start` with `{ready.type}`")
        if self.ready is None:
            self._started_at = self._clock()
        else:
            self.reconnects += 1
        self.ready = ready
        self._start = self._start.model_copy(update={"resume_token": ready.resume_token})
        self.state, self.is_draining = ClientState.OPEN, False
        processed = ready.last_seq if ready.resumed and ready.last_seq is not None else -1
        results = self._settle_unanswered(processed + 1, "lost")
        self._pending = {seq: self._check_size(replace(each, sent=False)) for seq, each in self._pending.items()}
        return results

    def smaller_image(self, frame: SourceFrame) -> SmallerImage | None:
        """Returns what to send instead of a frame that is larger than the service accepts. Takes time; needs no lock.

        Raises SettingsError if the camera's values are for the original size, but do not say so.
        """
        smaller = None if self.ready is None else fit_frame(frame, self.ready.limits)
        if smaller is not None and smaller.camera(self._start.camera) != self._start.camera:
            size = "[{}, {}]".format(*smaller.original)
            raise SettingsError(
                f"{smaller.describe()}, so the camera needs the size of its images", f'add "image_size": {size} to it'
            )
        if smaller is not None and not self._reported_size:
            self._reported_size = True
            _log.warning("%s", smaller.describe())
        return smaller

    def add_frame(self, frame: SourceFrame, data: bytes, smaller: SmallerImage | None = None) -> None:
        """Adds the next frame of the source, encoded as `data`, or `smaller`. Requires that the stream was opened.

        Accepts a frame although `wants_frame` is false now: since the source was asked for it, a lost connection may
        have returned earlier frames to the queue. Raises ProtocolError if its number does not rise.
        """
        if frame.seq <= self._last_seq:
            raise ProtocolError(f"frame {frame.seq} came after frame {self._last_seq}", "frame numbers must rise")
        self._last_seq = frame.seq
        pending = _PendingFrame(frame, data if smaller is None else smaller.data, smaller=smaller)
        self._pending[frame.seq] = self._check_size(pending)

    def end_source(self) -> None:
        """Records that the source has no more frames."""
        self._source_ended = True

    def messages_to_send(self) -> list[str | bytes]:
        """Returns the messages to send now: those of one frame, `end`, or none until something changes."""
        if self.state is not ClientState.OPEN or self.is_draining:
            return []
        pending = next((pending for pending in self._pending.values() if pending.waiting), None)
        if pending is None:
            return self._end_messages()
        if not self._has_credit:
            return []
        frame = pending.frame
        self._pending[frame.seq] = replace(pending, sent=True)
        header = FrameMessage(seq=frame.seq, timestamp=frame.timestamp, speed=frame.speed, indicator=frame.indicator)
        return [header.model_dump_json(exclude_none=True), pending.data]

    def receive(self, text: str | bytes) -> list[StreamResult]:
        """Handles a message after `ready`. Returns the results that it settles, in frame order.

        Raises the error that the service sent if it ends the stream or is not about a frame, and ProtocolError if the
        message is not valid here.
        """
        message = _parse(text)
        if isinstance(message, LanesMessage):
            return self._settle(message.seq, message)
        if isinstance(message, ErrorMessage):
            if message.fatal or message.seq is None:
                raise error_from_code(message.code, message.message, message.hint)
            if message.code == DrainingError.code:
                return self._return_to_queue(message.seq)
            return self._settle(message.seq, message)
        if isinstance(message, WarningMessage):
            self.warnings += (message,)
            return []
        if isinstance(message, DrainingMessage):
            self._drain(message.resume_token)
            return []
        if isinstance(message, SummaryMessage) and self.state is ClientState.ENDING:
            results = self._settle_unanswered(self._last_seq + 1)
            self._finish()
            return results
        raise ProtocolError(f"the service sent `{message.type}` in the middle of the stream")

    def connection_lost(self) -> list[StreamResult]:
        """Handles the loss of the socket. Returns the results that this settles.

        The stream is finished if the source has ended and every frame has its result.
        """
        self.state = ClientState.DISCONNECTED
        unanswered = [seq for seq, pending in self._pending.items() if pending.sent]
        if self._start.mode == "all" and unanswered:
            results = self._settle_unanswered(unanswered[0])
        else:
            results = self._settle_unanswered(self._last_seq + 1, "lost")
        if self._source_ended and not self._pending:
            self._finish()
        return results

    def give_up(self) -> list[StreamResult]:
        """Finishes the stream without another socket. Returns results for all frames that have none yet."""
        results = [self._settle_one_unanswered(seq, "lost") for seq in list(self._pending)]
        self._finish()
        return [result for result in results if result is not None]

    @property
    def _has_credit(self) -> bool:
        if self.ready is None:
            return False
        window = min(self._in_flight, self.ready.limits.credits)
        return sum(pending.sent for pending in self._pending.values()) < window

    def _end_messages(self) -> list[str | bytes]:
        if not self._source_ended:
            return []
        self.state = ClientState.ENDING
        return [EndMessage().model_dump_json()]

    def _check_size(self, pending: _PendingFrame) -> _PendingFrame:
        """Rejects a frame with more bytes than the service accepts. To send it would end the stream."""
        if self.ready is None or pending.rejection is not None:
            return pending
        size, limit = len(pending.data), self.ready.limits.max_bytes
        if size <= limit:
            return pending
        error = ImageTooLargeError(f"the frame has {size:,} bytes; the service accepts {limit:,}")
        return replace(pending, rejection=error_message(error, seq=pending.frame.seq))

    def _drain(self, resume_token: str | None) -> None:
        self.is_draining = True
        if resume_token is not None:
            self._start = self._start.model_copy(update={"resume_token": resume_token})

    def _return_to_queue(self, seq: int) -> list[StreamResult]:
        """Handles a frame that a draining service refused: mode `all` will send it again, mode `latest` loses it."""
        self._drain(None)
        self._check_sent(seq)
        results = self._settle_unanswered(seq)
        if self._start.mode == "all":
            self._pending[seq] = replace(self._pending[seq], sent=False)
            return results
        return [*results, *self._settle_unanswered(seq + 1, "lost")]

    def _settle(self, seq: int, message: LanesMessage | ErrorMessage) -> list[StreamResult]:
        self._check_sent(seq)
        if any(pending.waiting for number, pending in self._pending.items() if number < seq):
            raise ProtocolError(f"the service answered frame {seq} before an earlier frame that must be sent again")
        results = self._settle_unanswered(seq)
        pending = self._pending.pop(seq)
        frame = pending.frame
        if isinstance(message, LanesMessage):
            message = message if pending.smaller is None else pending.smaller.restore(message)
            self._counts["answered"] += 1
            return [*results, StreamResult(frame, lanes=message)]
        self._counts["failed"] += 1
        return [*results, StreamResult(frame, error=message)]

    def _check_sent(self, seq: int) -> None:
        if seq not in self._pending or not self._pending[seq].sent:
            raise ProtocolError(f"the service answered frame {seq}, which was not sent")

    def _settle_unanswered(self, end: int, outcome: _Unanswered | None = None) -> list[StreamResult]:
        """Returns the results of the frames before `end`, up to the first that is still waiting to be sent.

        The service answers in order, so a frame before an answered one gets no answer any more. By default its outcome
        is `dropped` in mode `latest`, and `lost` in mode `all`, which must not drop frames.
        """
        outcome = outcome or ("dropped" if self._start.mode == "latest" else "lost")
        results = []
        for seq in [seq for seq in self._pending if seq < end]:
            if self._pending[seq].waiting:
                break
            results.append(self._settle_one_unanswered(seq, outcome))
        return [result for result in results if result is not None]

    def _settle_one_unanswered(self, seq: int, outcome: _Unanswered) -> StreamResult | None:
        """Returns the result of a frame that the service did not answer, or None if it counts as dropped."""
        pending = self._pending.pop(seq)
        self._counts["failed" if pending.rejection else outcome] += 1
        if pending.rejection is not None:
            return StreamResult(pending.frame, error=pending.rejection)
        if outcome == "dropped":
            return None
        error = LostError("the result of this frame was lost with the connection")
        return StreamResult(pending.frame, error=error_message(error, seq=seq))

    def _finish(self) -> None:
        self.state = ClientState.FINISHED
        self.summary = StreamSummary(
            frames=self._counts.total(),
            answered=self._counts["answered"],
            failed=self._counts["failed"],
            dropped=self._counts["dropped"],
            lost=self._counts["lost"],
            duration_s=0.0 if self.ready is None else round(self._clock() - self._started_at, 3),
        )


def _parse(text: str | bytes) -> ServerMessage:
    if isinstance(text, bytes):
        raise ProtocolError("the service sent a binary message; only text messages are expected")
    return parse_server_message(text)
