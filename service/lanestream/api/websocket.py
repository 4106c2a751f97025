"""The WebSocket of a stream: one task reads, one answers frames, one watches time limits, draining and eviction.

The rules are in `StreamProtocol`. The reader never waits for a frame to be processed: pongs are only handled while a
task reads, and a frame that waits in the kernel can't be replaced by a newer one.
"""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Final

from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from lanestream.api.connections import connection_of
from lanestream.api.problems import deny_handshake
from lanestream.api.request_id import current_request_id
from lanestream.errors import (
    BusyError,
    EvictedError,
    ExpiredError,
    LanestreamError,
    NoDetectorError,
    ProtocolError,
    UnauthorizedError,
    WorkerLostError,
    wire_status,
)
from lanestream.messages import lanes_message
from lanestream.protocol import (
    SUBPROTOCOL,
    WARNINGS,
    ErrorMessage,
    ReadyMessage,
    ServerMessage,
    StartMessage,
    error_message,
    parse_client_message,
)
from lanestream.streaming.stream_protocol import FrameOutcome, StreamProtocol, StreamState
from lanestream.workers.frame_worker import EncodedFrame

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from lanestream.api.service import Service
    from lanestream.messages import ProcessedFrame
    from lanestream.protocol import WarningCode
    from lanestream.streaming.session_registry import Caller, OpenSession
    from lanestream.streaming.stream_protocol import IncomingFrame
    from lanestream.workers.admission import Slot
    from lanestream.workers.capabilities import DetectorInfo

router = APIRouter()

_log = logging.getLogger(__name__)
_MAX_REASON_BYTES: Final = 123  # of a close frame, by RFC 6455
_NORMAL_CLOSURE: Final = 1000
_SERVICE_RESTART: Final = 1012
_MIN_WATCH_S: Final = 0.01
# A stream whose frames were in process when this many workers were lost is ended, and can't be resumed.
_MOST_WORKER_LOSSES: Final = 3
_FORGIVEN_AFTER: Final = 100


@router.websocket("/v1/stream")
async def stream(socket: WebSocket) -> None:
    """Serves one stream, from the handshake to the close."""
    service: Service = socket.app.state.service
    try:
        caller = service.authenticator.authenticate(socket)
        service.check_ready()
    except LanestreamError as error:
        await deny_handshake(socket, error)
        return
    subprotocols = socket.scope.get("subprotocols", [])
    await socket.accept(SUBPROTOCOL if SUBPROTOCOL in subprotocols else None)
    await StreamConnection(socket, service, caller).run()


class StreamConnection:
    """Connects one WebSocket with the protocol of its stream and its session."""

    def __init__(self, socket: WebSocket, service: Service, caller: Caller) -> None:
        self._socket = socket
        self._service = service
        self._caller = caller
        self._protocol = StreamProtocol(service.settings.stream_limits, time.monotonic())
        self._session: OpenSession | None = None
        self._work: asyncio.Task[ProcessedFrame] | None = None
        self._received = asyncio.Event()
        self._wake_watcher = asyncio.Event()
        self._evicted = False
        self._handed_over = False
        self._closed = self._close_counted = False
        self._worker_losses = 0
        self._answered_at_loss = 0
        self._connection = connection_of(socket.scope)
        self._charge = service.budget.charge(caller.quota)
        if self._connection is not None:
            self._connection.identify(caller.quota)

    def wake(self) -> None:
        """Makes the watcher check the time limits, and whether the stream must end."""
        self._wake_watcher.set()

    def hand_over(self) -> bool:
        """See OpenStream. Only a client that has a resume token can resume its session."""
        if self._handed_over or self._session is None or self._session.token is None:
            return False
        self._handed_over = True
        self.wake()
        return True

    async def run(self) -> None:
        """Serves the stream until either side ends it."""
        self._service.streams.add(self)
        try:
            await self._run_tasks()
        except WebSocketDisconnect as disconnect:
            self._count_close(disconnect.code)
        except Exception as error:
            if not isinstance(error, LanestreamError):
                _log.exception("stream failed", extra=self._log_fields("stream_failed"))
            await self._end_with(error)
        finally:
            await self._release_session()
            self._charge.set(0)
            self._service.streams.discard(self)

    async def _run_tasks(self) -> None:
        """Reads, answers and watches concurrently until one of the three tasks ends."""
        try:
            async with asyncio.TaskGroup() as group:
                tasks = [group.create_task(run()) for run in (self._read, self._answer, self._watch)]
                for task in tasks:
                    task.add_done_callback(lambda _: [other.cancel() for other in tasks])
        except ExceptionGroup as errors:
            raise errors.exceptions[0] from None

    async def _read(self) -> None:
        """Receives messages until the client disconnects or an error ends the stream."""
        while (message := await self._socket.receive())["type"] != "websocket.disconnect":
            try:
                await self._receive(message.pop("text", None), message.pop("bytes", None))
            except (ProtocolError, NoDetectorError) as error:
                await self._send(error_message(error))
            self._received.set()
        self._count_close(message["code"])

    async def _receive(self, text: str | None, data: bytes | None) -> None:
        now = time.monotonic()
        if text is None:
            self._receive_image(data or b"", now)
            return
        message = parse_client_message(text)
        if isinstance(message, StartMessage):
            # The only message that needs I/O: it opens or resumes a session.
            await self._start(message, now)
        else:
            self._protocol.receive_message(message, now)
        await self._send_pending()

    def _receive_image(self, data: bytes, now: float) -> None:
        metrics = self._service.metrics
        metrics.frame_received()
        try:
            replaced = self._protocol.receive_image(data, now, self._charge_for(data))
        except LanestreamError as error:
            metrics.frame_failed(error)
            raise
        self._charge.set(self._protocol.held_bytes)
        for _ in range(replaced):
            metrics.frame_dropped("superseded")
        if self._protocol.state is not StreamState.DRAINED:
            self._ensure_session()

    def _charge_for(self, data: bytes) -> BusyError | None:
        """Charges the caller for another frame. Returns the error if too much is kept for it already."""
        try:
            self._charge.set(self._protocol.held_bytes + len(data))
        except BusyError as error:
            # Its traceback would keep the image.
            return error.with_traceback(None)
        return None

    async def _start(self, message: StartMessage, now: float) -> None:
        # Checked first, so that options that can't be had leave the stream unchanged.
        detector = self._service.pool.capabilities.select(message.detector)
        options = self._service.session_options(message)
        self._service.check_ready()
        self._protocol.receive_start(message, now)
        session = await self._service.sessions.start(self._service.pool, self._caller, message, options)
        self._attach(session)
        if session.resume_outcome is not None:
            self._service.metrics.session_resumed(session.resume_outcome)
        if session.resumed:
            self._protocol.resume(session.last_seq, session.stream_s, time.monotonic())
        await self._send(self._ready(session, detector))

    def _ready(self, session: OpenSession, detector: DetectorInfo) -> ReadyMessage:
        return ReadyMessage(
            session=session.id,
            resume_token=session.token or "",
            resumed=session.resumed,
            last_seq=session.last_seq,
            mode=self._protocol.mode,
            detector=detector.detector,
            model=detector.model.name,
            provider=detector.model.provider,
            limits=self._service.limits,
        )

    def _ensure_session(self) -> OpenSession:
        """Returns the stream's session. Without `start`, opens one that can't be resumed: the client has no token."""
        if self._session is None:
            options = self._service.session_options(self._protocol.options)
            self._attach(self._service.sessions.open(self._service.pool, self._caller, options))
        assert self._session is not None  # noqa: S101 - attached above
        return self._session

    def _attach(self, session: OpenSession) -> None:
        self._session = session
        if self._connection is not None:
            self._connection.protect()
        session.on_evict = self._evict
        # The time limits of an open stream differ from those of the handshake.
        self.wake()
        self._service.metrics.session_opened()
        opened = "resumed" if session.resumed else "opened"
        caller, mode = self._caller.identity, self._protocol.mode
        detector = self._service.pool.capabilities.select(self._protocol.options.detector).detector
        _log.info(
            "stream %s by %s, mode %s, detector %s",
            *(opened, caller, mode, detector),
            extra=self._log_fields(f"stream_{opened}") | {"caller": caller, "mode": mode, "detector": detector},
        )

    async def _answer(self) -> None:
        """Answers frames in order, one at a time, until the stream is finished; then closes the socket."""
        while not self._protocol.finished:
            if self._protocol.has_waiting_frame:
                await self._send(await self._answer_next())
                await self._send_pending()
                continue
            self._received.clear()
            await self._received.wait()
        self._protocol.finish()
        await self._send_pending()
        # A client that has received the summary may open its next session right away.
        await self._release_session()
        if self._protocol.ended_by_client:
            await self._send(self._protocol.summary(time.monotonic()))
            await self._close(_NORMAL_CLOSURE)
        else:
            await self._close(_SERVICE_RESTART, "the service is about to stop")

    async def _answer_next(self) -> ServerMessage:
        """Waits for a slot in the worker pool and answers the frame that is next then."""
        self._protocol.request_slot()
        latest = self._protocol.mode == "latest"
        async with AsyncExitStack() as admission:
            slot = await admission.enter_async_context(self._service.pool.admit(self._caller.quota, latest=latest))
            frame = self._protocol.take_frame()
            assert frame is not None  # noqa: S101 - a waiting frame is replaced, never removed
            return await self._answer_frame(frame, slot, admission)

    async def _answer_frame(self, frame: IncomingFrame, slot: Slot, admission: AsyncExitStack) -> ServerMessage:
        session = self._ensure_session()
        try:
            if frame.refusal is not None:
                raise frame.refusal
            self._work = asyncio.create_task(self._process(session, frame, slot, admission.pop_all()))
            # A frame is processed to its end even if the stream ends, so that the session's state stays consistent.
            processed = await asyncio.shield(self._work)
        except Exception as error:
            trace_id = self._trace(session, frame, error=error)
            if not isinstance(error, LanestreamError):
                _log.exception("frame failed", extra=self._log_fields("frame_failed", frame.seq, trace_id))
            self._service.metrics.frame_failed(error)
            self._complete(session, FrameOutcome.EXPIRED if isinstance(error, ExpiredError) else FrameOutcome.FAILED)
            self._check_worker_losses(error)
            return error_message(error, seq=frame.seq)
        self._complete(session, FrameOutcome.ANSWERED)
        timing = processed.result.timing_ms
        self._service.metrics.frame_processed(timing, 1e-3 * timing["total"])
        self._warn(processed.result.warnings, frame.seq, self._trace(session, frame, timing))
        return lanes_message(
            processed,
            seq=frame.seq,
            timestamp=frame.timestamp,
            dropped=self._protocol.dropped,
        )

    def _trace(
        self,
        session: OpenSession,
        frame: IncomingFrame,
        timing_ms: Mapping[str, float] | None = None,
        error: Exception | None = None,
    ) -> str | None:
        """Makes the span of a frame, if frames are traced. Returns its trace id if it is sampled."""
        tracer = self._service.tracer
        if tracer is None:
            return None
        attributes: dict[str, str | int] = {
            "session": session.id,
            "seq": frame.seq,
            "caller": self._caller.identity,
            "request_id": current_request_id(),
        }
        return tracer.record(frame.arrived, attributes, timing_ms, error)

    def _warn(self, codes: Sequence[WarningCode], seq: int, trace_id: str | None) -> None:
        for code in codes:
            self._protocol.warn(code, seq)
            self._service.metrics.timestamp_warning(code)
            fields = self._log_fields("client_warning", seq, trace_id) | {"code": code}
            _log.warning("%s", WARNINGS[code][0], extra=fields)

    def _check_worker_losses(self, error: Exception) -> None:
        """Raises the error, which ends the stream for good, if the stream's frames have cost several workers."""
        if isinstance(error, WorkerLostError):
            answered = self._protocol.answered
            # A frame that was in process beside the one that ended the worker is not held against its stream for long.
            self._worker_losses = 1 if answered - self._answered_at_loss > _FORGIVEN_AFTER else self._worker_losses + 1
            self._answered_at_loss = answered
            if self._worker_losses >= _MOST_WORKER_LOSSES:
                raise error

    async def _process(
        self, session: OpenSession, frame: IncomingFrame, slot: Slot, admission: AsyncExitStack
    ) -> ProcessedFrame:
        """Returns the lanes of a frame, and holds its admission until then, even if the stream ends before."""
        session.processing = True
        async with admission:
            try:
                encoded = EncodedFrame(frame.data, frame.timestamp, frame.arrived, frame.deadline, frame.motion)
                processed = await self._service.pool.run(session.handle, encoded, slot)
                session.last_seq, session.stream_s = frame.seq, self._protocol.stream_s(time.monotonic())
                return processed
            finally:
                session.processing = False

    def _complete(self, session: OpenSession, outcome: FrameOutcome) -> None:
        self._protocol.complete_frame(outcome, time.monotonic())
        self._charge.set(self._protocol.held_bytes)
        self._service.sessions.schedule_save(session)

    async def _watch(self) -> None:
        """Raises the error that ends an idle, too old, evicted or no longer allowed stream. Announces a drain."""
        while not (self._service.draining or self._handed_over):
            try:
                async with asyncio.timeout(max(self._seconds_to_next_limit(), _MIN_WATCH_S)):
                    await self._wake_watcher.wait()
            except TimeoutError:
                self._protocol.check_idle(time.monotonic())
                if self._session is not None:
                    self._service.sessions.check_age(self._session)
            self._wake_watcher.clear()
            if self._evicted:
                raise EvictedError(
                    "the session was resumed over another socket", "use a resume token on one socket at a time"
                )
            if not self._service.authenticator.knows(self._caller):
                raise UnauthorizedError("the API key of this stream was removed", "use another key")
        token = None if self._session is None else self._session.token
        self._protocol.drain(token, self._service.settings.drain_s)
        await self._send_pending()
        self._received.set()
        await asyncio.Event().wait()

    def _seconds_to_next_limit(self) -> float:
        idle_s_left = self._protocol.idle_s_left(time.monotonic())
        if self._session is None:
            return idle_s_left
        return min(idle_s_left, self._service.sessions.life_s_left(self._session))

    def _evict(self) -> None:
        self._evicted = True
        self._wake_watcher.set()

    async def _release_session(self) -> None:
        """Closes the session once the frame in progress is done."""
        session, self._session = self._session, None
        if session is None:
            return
        if self._work is not None:
            await asyncio.wait([self._work])
        resumable = not self._protocol.ended_by_client and self._worker_losses < _MOST_WORKER_LOSSES
        await self._service.sessions.close(session, resumable=resumable)
        self._service.metrics.session_closed()
        count = self._protocol.summary(time.monotonic())
        for _ in range(count.frames - count.answered - count.failed - count.dropped):
            self._service.metrics.frame_dropped("disconnected")
        _log.info(
            "stream closed after %.1f s: %d frames, %d answered, %d failed, %d dropped",
            *(count.duration_s, count.frames, count.answered, count.failed, count.dropped),
            extra={
                "event": "stream_closed",
                "session": session.id,
                "caller": self._caller.identity,
                **count.model_dump(exclude={"type"}),
            },
        )

    async def _send_pending(self) -> None:
        for message in self._protocol.messages_to_send():
            await self._send(message)

    async def _send(self, message: ServerMessage) -> None:
        """Sends a message, unless this side has closed the socket: messages may still arrive then, which are errors."""
        if self._closed:
            return
        if isinstance(message, ErrorMessage):
            self._service.metrics.refused(message.code)
        await self._socket.send_text(message.model_dump_json())

    async def _close(self, code: int, reason: str = "") -> None:
        self._count_close(code)
        self._closed = True
        await self._socket.close(code, reason)

    def _count_close(self, code: int) -> None:
        """Counts the code of the side that closes first; the other side's reply is not a second close."""
        if not self._close_counted:
            self._close_counted = True
            self._service.metrics.socket_closed(code)

    async def _end_with(self, error: Exception) -> None:
        """Sends the error that ends the stream, and closes the socket once the session is ready to be resumed.

        Neither waits for the other: a peer that does not read must not keep the session.
        """
        message = error_message(error, fatal=True)
        reason = message.message.encode()[:_MAX_REASON_BYTES].decode(errors="ignore")
        releasing = asyncio.create_task(self._release_session())
        try:
            await self._send(message)
            await releasing
            await self._close(wire_status(error).close_code, reason)
        except (WebSocketDisconnect, RuntimeError):
            _log.debug("the client disconnected before this error was sent: %s", message.message)
        finally:
            await releasing

    def _log_fields(
        self, event: str, seq: int | None = None, trace_id: str | None = None
    ) -> dict[str, str | int | None]:
        """Returns the fields that log records of this stream carry besides their message and the request's fields."""
        session = None if self._session is None else self._session.id
        return {"event": event, "session": session, "seq": seq, "trace_id": trace_id}
