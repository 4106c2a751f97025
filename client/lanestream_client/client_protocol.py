"""The client's side of a stream, without its sockets: shared by the client that blocks and the one that awaits.

Keeps a few frames in flight, one unless told otherwise: more would wait in the service and make every answer older,
which pays only where the network is slower than the service. None has to be dropped of a source that can wait.

A stream outlives its sockets. Each frame of the source comes to one result, or is counted as dropped, whatever happens
to a socket: in mode `latest` what was sent and not answered is lost with it; in mode `all` it is sent again, unless the
session goes on and has worked on it already, because then only the answer is gone.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

from lanestream.errors import (
    DrainingError,
    ImageTooLargeError,
    LostError,
    ProtocolError,
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
    error_message,
    parse_server_message,
)
from lanestream_client.frames import SourceFrame, StreamResult, StreamSummary


@dataclass(frozen=True)
class _Pending:
    """A frame without a result: it waits to be sent, has been sent, or was refused here."""

    frame: SourceFrame
    data: bytes
    sent: bool = False
    refused: ErrorMessage | None = None

    @property
    def waits(self) -> bool:
        return not self.sent and self.refused is None


class ClientProtocol:
    """What is to be sent, was sent and is owed, with up to `in_flight` frames unanswered.

    None of its methods waits; calls from several threads need a lock around them. `ready` is what the service said when
    it opened the stream last, `reconnects` how often it did so again, `summary` the count after the end.
    """

    def __init__(self, start: StartMessage, *, in_flight: int = 1, clock: Callable[[], float] = time.monotonic) -> None:
        self.ready: ReadyMessage | None = None
        self.summary: StreamSummary | None = None
        self.reconnects = 0
        self._start = start
        self._in_flight = in_flight
        self._clock = clock
        self._began = 0.0
        self._pending: dict[int, _Pending] = {}  # in rising order
        self._last_seq = -1
        self._count: Counter[str] = Counter()
        self._source_is_over = False
        self._is_open = False
        self._is_draining = False
        self._end_was_sent = False

    @property
    def is_draining(self) -> bool:
        """Whether the service said, over the latest socket, that it is about to stop."""
        return self._is_draining

    @property
    def wants_frame(self) -> bool:
        """Whether the next frame of the source is wanted."""
        return not any(pending.waits for pending in self._pending.values())

    def opening(self) -> str:
        """The first message over a socket; it asks for the session that the socket before had."""
        return self._start.model_dump_json(exclude_none=True)

    def opened(self, text: str | bytes) -> list[StreamResult]:
        """Takes the service's answer to the opening in; the results of frames whose answers are lost.

        Raises the error that it tells, ProtocolError where it is odd.
        """
        ready = _parsed(text)
        if isinstance(ready, ErrorMessage):
            raise error_from_code(ready.code, ready.message, ready.hint)
        if isinstance(ready, DrainingMessage):
            raise DrainingError("the service is about to stop")
        if not isinstance(ready, ReadyMessage):
            raise ProtocolError(f"the service answered `start` with `{ready.type}`")
        if self.ready is None:
            self._began = self._clock()
        else:
            self.reconnects += 1
        self.ready = ready
        self._start = self._start.model_copy(update={"resume_token": ready.resume_token})
        self._is_open, self._is_draining, self._end_was_sent = True, False, False
        worked_on = ready.last_seq if ready.resumed and ready.last_seq is not None else -1
        results = self._settled_before(worked_on + 1, missing="lost")
        self._pending = {seq: self._checked(replace(each, sent=False)) for seq, each in self._pending.items()}
        return results

    def offer(self, frame: SourceFrame, data: bytes) -> None:
        """Takes the next frame of the source in, encoded as `data`. To be called when the stream was opened once.

        It was wanted when the source was asked for it; meanwhile frames before it may have to be sent again.
        Raises ProtocolError where its number is not above that of the frame before.
        """
        if frame.seq <= self._last_seq:
            raise ProtocolError(f"frame {frame.seq} came after frame {self._last_seq}", "numbers of frames must rise")
        self._last_seq = frame.seq
        self._pending[frame.seq] = self._checked(_Pending(frame, data))

    def no_more(self) -> None:
        """The source is over."""
        self._source_is_over = True

    def outgoing(self) -> list[str | bytes]:
        """The messages to send now: those of a frame, or the `end`; none at all until something else happens."""
        if not self._is_open or self._is_draining:
            return []
        waiting = next((pending for pending in self._pending.values() if pending.waits), None)
        if waiting is None:
            return self._ending()
        if not self._has_room:
            return []
        frame = waiting.frame
        self._pending[frame.seq] = replace(waiting, sent=True)
        announced = FrameMessage(seq=frame.seq, timestamp=frame.timestamp)
        return [announced.model_dump_json(exclude_none=True), waiting.data]

    def incoming(self, text: str | bytes) -> list[StreamResult]:
        """Takes a later message of the service in; the results that it settles, in the frames' order.

        Raises the error that ends the stream, or that is not about a frame.
        """
        message = _parsed(text)
        if isinstance(message, DrainingMessage):
            self._drain(message.resume_token)
            return []
        if isinstance(message, SummaryMessage) and self._end_was_sent:
            results = self._settled_before(self._last_seq + 1)
            self._sum_up()
            return results
        if isinstance(message, ErrorMessage):
            if message.fatal or message.seq is None:
                raise error_from_code(message.code, message.message, message.hint)
            if message.code == DrainingError.code:
                return self._put_back(message.seq)
            return self._settle(message.seq, message)
        if isinstance(message, LanesMessage):
            return self._settle(message.seq, message)
        raise ProtocolError(f"the service sent `{message.type}` in the middle of the stream")

    def lost_connection(self) -> list[StreamResult]:
        """The socket is gone; the results that this comes to. There is a summary then where nothing is left to do."""
        self._is_open = False
        doubtful = [seq for seq, pending in self._pending.items() if pending.sent]
        if self._start.mode == "all" and doubtful:
            results = self._settled_before(doubtful[0])
        else:
            results = self._settled_before(self._last_seq + 1, missing="lost")
        if self._source_is_over and not self._pending:
            self._sum_up()
        return results

    def given_up(self) -> list[StreamResult]:
        """There will be no other socket; the results of all frames that have none yet. There is a summary then."""
        self._is_open = False
        results = [self._given_back(seq, "lost") for seq in list(self._pending)]
        self._sum_up()
        return [result for result in results if result is not None]

    @property
    def _has_room(self) -> bool:
        if self.ready is None:
            return False
        window = min(self._in_flight, self.ready.limits.credits)
        return sum(pending.sent for pending in self._pending.values()) < window

    def _ending(self) -> list[str | bytes]:
        if self._end_was_sent or not self._source_is_over:
            return []
        self._end_was_sent = True
        return [EndMessage().model_dump_json()]

    def _checked(self, pending: _Pending) -> _Pending:
        """The frame, refused where it has more bytes than the service accepts, which would end the stream."""
        if self.ready is None or pending.refused is not None:
            return pending
        size, most = len(pending.data), self.ready.limits.max_bytes
        if size <= most:
            return pending
        error = ImageTooLargeError(f"the frame has {size:,} bytes; the service accepts {most:,}")
        return replace(pending, refused=error_message(error, seq=pending.frame.seq))

    def _drain(self, token: str | None) -> None:
        self._is_draining = True
        if token is not None:
            self._start = self._start.model_copy(update={"resume_token": token})

    def _put_back(self, seq: int) -> list[StreamResult]:
        """A frame came too late for a service that stops: another can do it, but only a frame that can wait waits."""
        self._drain(None)
        self._check_due(seq)
        results = self._settled_before(seq)
        if self._start.mode == "all":
            self._pending[seq] = replace(self._pending[seq], sent=False)
            return results
        return [*results, *self._settled_before(seq + 1, missing="lost")]

    def _settle(self, seq: int, message: LanesMessage | ErrorMessage) -> list[StreamResult]:
        self._check_due(seq)
        if any(pending.waits for number, pending in self._pending.items() if number < seq):
            raise ProtocolError(f"the service answered frame {seq} before one that it has still to be sent")
        results = self._settled_before(seq)
        frame = self._pending.pop(seq).frame
        if isinstance(message, LanesMessage):
            self._count["answered"] += 1
            return [*results, StreamResult(frame, lanes=message)]
        self._count["failed"] += 1
        return [*results, StreamResult(frame, error=message)]

    def _check_due(self, seq: int) -> None:
        if seq not in self._pending or not self._pending[seq].sent:
            raise ProtocolError(f"the service answered frame {seq}, which was not sent")

    def _settled_before(self, seq: int, missing: str | None = None) -> list[StreamResult]:
        """The results of the frames before `seq`, up to the first that is still to be sent.

        Answers come in order, so frames that were sent and have none are `missing`: dropped by the service in mode
        `latest`, and lost in mode `all`, where none may be dropped, unless another word is given.
        """
        missing = missing or ("dropped" if self._start.mode == "latest" else "lost")
        results = []
        for number in [number for number in self._pending if number < seq]:
            if self._pending[number].waits:
                break
            results.append(self._given_back(number, missing))
        return [result for result in results if result is not None]

    def _given_back(self, seq: int, missing: str) -> StreamResult | None:
        """The result of a frame that no answer came for; None where it counts as dropped."""
        pending = self._pending.pop(seq)
        self._count["failed" if pending.refused else missing] += 1
        if pending.refused is not None:
            return StreamResult(pending.frame, error=pending.refused)
        if missing == "dropped":
            return None
        error = LostError("the answer to this frame was lost with the connection")
        return StreamResult(pending.frame, error=error_message(error, seq=seq))

    def _sum_up(self) -> None:
        self.summary = StreamSummary(
            frames=self._count.total(),
            answered=self._count["answered"],
            failed=self._count["failed"],
            dropped=self._count["dropped"],
            lost=self._count["lost"],
            duration_s=0.0 if self.ready is None else round(self._clock() - self._began, 3),
        )


def _parsed(text: str | bytes) -> ServerMessage:
    if isinstance(text, bytes):
        raise ProtocolError("the service sent a binary message")
    return parse_server_message(text)
