"""The WebSocket of a stream: one task always reads, one answers frame after frame, one watches the clock and the door.

The rules are in `stream_rules`. The reader never waits for a frame's work, because pongs are only seen while something
reads, and because a frame that waits in the kernel can't be replaced by a newer one.
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Final

from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from lanestream.api.problems import deny
from lanestream.errors import (
    EvictedError,
    ExpiredError,
    LanestreamError,
    NoDetectorError,
    ProtocolError,
    answer_to,
)
from lanestream.messages import lanes_message
from lanestream.protocol import (
    SUBPROTOCOL,
    DrainingMessage,
    EndMessage,
    ErrorMessage,
    FrameMessage,
    Message,
    ReadyMessage,
    StartMessage,
    error_message,
    parse_client_message,
)
from lanestream.streaming.stream_protocol import Outcome, StreamProtocol, check_age
from lanestream.workers.frame_worker import EncodedFrame

if TYPE_CHECKING:
    from lanestream.api.service import Service
    from lanestream.messages import ProcessedFrame
    from lanestream.streaming.caller import Caller
    from lanestream.streaming.session_registry import OpenSession
    from lanestream.streaming.stream_protocol import IncomingFrame
    from lanestream.workers.capabilities import Offer

router = APIRouter()

_log = logging.getLogger(__name__)
_MOST_REASON_BYTES: Final = 123  # of a close frame, by RFC 6455
_NORMAL: Final = 1000
_RESTART: Final = 1012
_SHORTEST_WATCH_S: Final = 0.01


@router.websocket("/v1/stream")
async def stream(socket: WebSocket) -> None:
    """One stream of frames, from the handshake to the close."""
    service: Service = socket.app.state.service
    try:
        caller = service.authenticator.admit(socket)
        service.check_open()
    except LanestreamError as error:
        await deny(socket, error)
        return
    offered = socket.scope.get("subprotocols", [])
    await socket.accept(SUBPROTOCOL if SUBPROTOCOL in offered else None)
    await StreamHandler(socket, service, caller).run()


class StreamHandler:
    """Joins one socket, one session and the rules of their stream."""

    def __init__(self, socket: WebSocket, service: Service, caller: Caller) -> None:
        self._socket = socket
        self._service = service
        self._caller = caller
        self._rules = StreamProtocol(service.settings.stream_limits, time.monotonic())
        self._opened: OpenSession | None = None
        self._work: asyncio.Task[ProcessedFrame] | None = None
        self._news = asyncio.Event()
        self._alarm = asyncio.Event()
        self._evicted = False
        self._closed = False

    def wake(self) -> None:
        """Has the stream look at the clock, and whether the service is about to stop."""
        self._alarm.set()

    async def run(self) -> None:
        """Serves the stream until either side ends it."""
        self._service.streams.add(self)
        try:
            await self._converse()
        except WebSocketDisconnect as gone:
            self._count_close(gone.code)
        except Exception as error:
            if not isinstance(error, LanestreamError):
                _log.exception("stream failed", extra=self._named())
            await self._end_with(error)
        finally:
            await self._release()
            self._service.streams.discard(self)

    async def _converse(self) -> None:
        """Reads, answers and watches at once; the end of one is the end of all."""
        try:
            async with asyncio.TaskGroup() as tasks:
                all_of_them = [tasks.create_task(step()) for step in (self._read, self._answer, self._watch)]
                for task in all_of_them:
                    task.add_done_callback(lambda _: [other.cancel() for other in all_of_them])
        except ExceptionGroup as group:
            raise group.exceptions[0] from None

    async def _read(self) -> None:
        """Takes messages in as they come, until the client is gone or breaks a rule that ends the stream."""
        while (message := await self._socket.receive())["type"] != "websocket.disconnect":
            try:
                await self._take_in(message.get("text"), message.get("bytes"))
            except (ProtocolError, NoDetectorError) as error:
                await self._tell(error)
            self._news.set()
        self._count_close(message["code"])

    async def _take_in(self, text: str | None, data: bytes | None) -> None:
        now = time.monotonic()
        if text is None:
            self._receive(data or b"", now)
            return
        message = parse_client_message(text)
        if isinstance(message, StartMessage):
            # First of all, because a detector that is not there leaves the stream as it was.
            offer = self._service.runner.offers.chosen(message.detector)
            self._service.check_open()
            self._rules.start(message, now)
            await self._start(message, offer)
        elif isinstance(message, FrameMessage):
            self._rules.announce(message, now)
        elif isinstance(message, EndMessage):
            self._rules.end(now)

    def _receive(self, data: bytes, now: float) -> None:
        metrics = self._service.metrics
        metrics.frame_received()
        try:
            superseded = self._rules.receive(data, now)
        except LanestreamError as error:
            metrics.frame_failed(error)
            raise
        for _ in range(superseded):
            metrics.frame_dropped("superseded")
        if not self._rules.over:
            self._ensure_session()

    async def _start(self, message: StartMessage, offer: Offer) -> None:
        opened = await self._service.sessions.start(self._service.runner, self._caller, message)
        self._attach(opened)
        if opened.resumption is not None:
            self._service.metrics.session_resumed(opened.resumption)
        if opened.resumption == "resumed":
            self._rules.go_on(opened.last_seq, opened.stream_s, time.monotonic())
        await self._send(self._ready(opened, offer))

    def _ensure_session(self) -> OpenSession:
        """The stream's session; a first frame opens one that can't be resumed, because nobody was told its token."""
        if self._opened is None:
            self._attach(self._service.sessions.open(self._service.runner, self._caller))
        assert self._opened is not None  # noqa: S101 - attached just now
        return self._opened

    def _attach(self, opened: OpenSession) -> None:
        self._opened = opened
        opened.on_evict = self._evict
        # An open stream has other limits of time.
        self.wake()
        self._service.metrics.session_opened()
        options = self._rules.options
        detector = self._service.runner.offers.chosen(options.detector).detector
        how = "resumed" if opened.resumption == "resumed" else "opened"
        told = (how, self._caller.identity, options.mode, detector)
        _log.info("stream %s by %s, mode %s, detector %s", *told, extra=self._named())

    def _ready(self, opened: OpenSession, offer: Offer) -> ReadyMessage:
        return ReadyMessage(
            session=opened.id,
            resume_token=opened.token or "",
            resumed=opened.resumption == "resumed",
            last_seq=opened.last_seq,
            mode=self._rules.mode,
            detector=offer.detector,
            model=offer.network.name,
            provider=offer.network.provider,
            limits=self._service.limits,
        )

    async def _answer(self) -> None:
        """Answers frames one at a time and in order, until the stream is finished; then says so and closes."""
        while not self._rules.finished:
            if self._rules.has_waiting:
                await self._send(await self._next_answer())
                continue
            self._news.clear()
            await self._news.wait()
        for late in self._rules.rest():
            if late.refusal is not None:
                await self._send(self._problem(late.refusal, late.seq))
        # Whoever has seen the summary finds the place free.
        await self._release()
        if self._rules.ended:
            await self._send(self._rules.summary(time.monotonic()))
            await self._close(_NORMAL)
        else:
            await self._close(_RESTART, "the service is about to stop")

    async def _next_answer(self) -> Message:
        """The answer to the next frame. Which one that is shows when its turn has come: until then newer ones count."""
        self._rules.queue(True)
        async with self._service.runner.turn(fresh=self._rules.mode == "latest"):
            self._rules.queue(False)
            frame = self._rules.take()
            assert frame is not None  # noqa: S101 - of waiting frames one always stays
            return await self._answer_to(frame)

    async def _answer_to(self, frame: IncomingFrame) -> Message:
        opened = self._ensure_session()
        try:
            if frame.refusal is not None:
                raise frame.refusal
            self._work = asyncio.create_task(self._process(opened, frame))
            # The work goes on where the stream ends meanwhile: half of it would leave the session between two frames.
            processed = await asyncio.shield(self._work)
        except Exception as error:
            if not isinstance(error, LanestreamError):
                _log.exception("frame failed", extra=self._named(frame.seq))
            self._service.metrics.frame_failed(error)
            self._settle(Outcome.EXPIRED if isinstance(error, ExpiredError) else Outcome.FAILED)
            return self._problem(error, frame.seq)
        self._settle(Outcome.ANSWERED)
        timing = processed.result.timing_ms
        self._service.metrics.frame_processed(timing, 1e-3 * timing["total"])
        return lanes_message(
            processed,
            seq=frame.seq,
            timestamp=frame.timestamp,
            dropped=self._rules.dropped,
            camera=self._rules.options.camera,
        )

    async def _process(self, opened: OpenSession, frame: IncomingFrame) -> ProcessedFrame:
        opened.working = True
        try:
            encoded = EncodedFrame(frame.data, frame.timestamp, frame.arrived, frame.deadline)
            processed = await self._service.runner.run(opened.camera, encoded)
            opened.last_seq, opened.stream_s = frame.seq, self._rules.stream_s(time.monotonic())
            return processed
        finally:
            opened.working = False

    def _settle(self, outcome: Outcome) -> None:
        self._rules.settle(outcome, time.monotonic())
        if self._opened is not None:
            self._service.sessions.note(self._opened)

    async def _watch(self) -> None:
        """Ends the stream that is silent or too old, or whose session is wanted elsewhere; tells of draining once."""
        while not self._service.draining:
            try:
                async with asyncio.timeout(max(self._seconds_left(), _SHORTEST_WATCH_S)):
                    await self._alarm.wait()
            except TimeoutError:
                self._rules.check_silence(time.monotonic())
                if self._opened is not None:
                    check_age(self._service.sessions.age_s(self._opened), self._service.settings.session_s)
            self._alarm.clear()
            if self._evicted:
                raise EvictedError("the session goes on over another socket", "a resume token is for one at a time")
        self._rules.drain()
        token = None if self._opened is None else self._opened.token
        await self._send(DrainingMessage(resume_token=token, deadline_s=self._service.settings.drain_s))
        self._news.set()
        await asyncio.Event().wait()

    def _seconds_left(self) -> float:
        silence = self._rules.silence_left(time.monotonic())
        if self._opened is None:
            return silence
        return min(silence, self._service.settings.session_s - self._service.sessions.age_s(self._opened))

    def _evict(self) -> None:
        self._evicted = True
        self._alarm.set()

    async def _release(self) -> None:
        """Lets go of the session, after the frame in work."""
        opened, self._opened = self._opened, None
        if opened is None:
            return
        if self._work is not None:
            await asyncio.wait([self._work])
        await self._service.sessions.close(opened, for_good=self._rules.ended)
        self._service.metrics.session_closed()
        count = self._rules.summary(time.monotonic())
        for _ in range(count.frames - count.answered - count.failed - count.dropped):
            self._service.metrics.frame_dropped("disconnected")
        _log.info(
            "stream closed after %.1f s: %d frames, %d answered, %d failed, %d dropped",
            *(count.duration_s, count.frames, count.answered, count.failed, count.dropped),
            extra={"session": opened.id},
        )

    async def _tell(self, error: LanestreamError) -> None:
        await self._send(self._problem(error))

    def _problem(self, error: Exception, seq: int | None = None, *, fatal: bool = False) -> ErrorMessage:
        told = error_message(error, seq=seq, fatal=fatal)
        self._service.metrics.refused(told.code)
        return told

    async def _send(self, message: Message) -> None:
        await self._socket.send_text(message.model_dump_json())

    async def _close(self, code: int, reason: str = "") -> None:
        self._count_close(code)
        await self._socket.close(code, reason)

    def _count_close(self, code: int) -> None:
        """The side that closes first gives the code; what the other one answers is no second close."""
        if not self._closed:
            self._closed = True
            self._service.metrics.socket_closed(code)

    async def _end_with(self, error: Exception) -> None:
        """Tells what ended the stream. Whoever sees its socket closed finds its session ready to be resumed."""
        told = self._problem(error, fatal=True)
        reason = told.message.encode()[:_MOST_REASON_BYTES].decode(errors="ignore")
        try:
            await self._send(told)
            await self._release()
            await self._close(answer_to(error).close_code, reason)
        except (WebSocketDisconnect, RuntimeError):
            _log.debug("the client was gone before it could be told: %s", told.message)

    def _named(self, seq: int | None = None) -> dict[str, str | int | None]:
        """What log lines tell of the stream beside their message."""
        return {"session": None if self._opened is None else self._opened.id, "seq": seq}
