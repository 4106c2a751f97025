"""The WebSocket of a stream: one task always reads, one answers frame after frame; the rules are in `stream_rules`.

The reader never waits for a frame's work, because pongs are only seen while something reads, and because a frame that
waits in the kernel can't be replaced by a newer one.
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Final

from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from lanestream.errors import LanestreamError, NoDetectorError, ProtocolError, answer_to
from lanestream.messages import lanes_message
from lanestream.protocol import (
    SUBPROTOCOL,
    EndMessage,
    FrameMessage,
    Message,
    ReadyMessage,
    StartMessage,
    error_message,
    parse_client_message,
)
from lanestream.sessions.runner import EncodedFrame
from lanestream.sessions.stream_rules import StreamRules

if TYPE_CHECKING:
    from lanestream.api.service import Service
    from lanestream.detection import Pipeline
    from lanestream.sessions.manager import OpenSession
    from lanestream.sessions.stream_rules import IncomingFrame

router = APIRouter()

_log = logging.getLogger(__name__)
_MOST_REASON_BYTES: Final = 123  # of a close frame, by RFC 6455


@router.websocket("/v1/stream")
async def stream(socket: WebSocket) -> None:
    """One stream of frames, from the handshake to the close."""
    service: Service = socket.app.state.service
    offered = socket.scope.get("subprotocols", [])
    await socket.accept(SUBPROTOCOL if SUBPROTOCOL in offered else None)
    await StreamHandler(socket, service).run()


class StreamHandler:
    """Joins one socket, one session and the rules of their stream."""

    def __init__(self, socket: WebSocket, service: Service) -> None:
        self._socket = socket
        self._service = service
        self._rules = StreamRules(service.settings.credits, time.monotonic())
        self._opened: OpenSession | None = None
        self._news = asyncio.Event()

    async def run(self) -> None:
        """Serves the stream until either side ends it."""
        try:
            await self._converse()
        except WebSocketDisconnect:
            pass
        except Exception as error:
            if not isinstance(error, LanestreamError):
                _log.exception("stream failed")
            await self._close_with(error)
        finally:
            self._release()

    async def _converse(self) -> None:
        """Reads and answers at once; the end of either is the end of both."""
        try:
            async with asyncio.TaskGroup() as tasks:
                reader, answerer = tasks.create_task(self._read()), tasks.create_task(self._answer())
                reader.add_done_callback(lambda _: answerer.cancel())
                answerer.add_done_callback(lambda _: reader.cancel())
        except ExceptionGroup as group:
            raise group.exceptions[0] from None

    async def _read(self) -> None:
        """Takes messages in as they come, until the client is gone or breaks a rule that ends the stream."""
        while (message := await self._socket.receive())["type"] != "websocket.disconnect":
            try:
                await self._take_in(message.get("text"), message.get("bytes"))
            except (ProtocolError, NoDetectorError) as error:
                await self._send(error_message(error))
            self._news.set()

    async def _take_in(self, text: str | None, data: bytes | None) -> None:
        if text is None:
            self._rules.receive(data or b"", time.monotonic())
            self._ensure_session()
            return
        message = parse_client_message(text)
        if isinstance(message, StartMessage):
            # First of all, because a detector that is not there leaves the stream as it was.
            pipeline = self._service.loaded.engine.pipeline(message.detector)
            self._rules.start(message)
            await self._send(self._ready(self._ensure_session(), pipeline))
        elif isinstance(message, FrameMessage):
            self._rules.announce(message)
        elif isinstance(message, EndMessage):
            self._rules.end()

    def _ensure_session(self) -> OpenSession:
        if self._opened is None:
            engine, options = self._service.loaded.engine, self._rules.options
            self._opened = self._service.sessions.open(engine, options.horizon, options.detector)
            detector = engine.pipeline(options.detector).name
            _log.info("stream %s opened, mode %s, detector %s", self._opened.id, options.mode, detector)
        return self._opened

    def _ready(self, opened: OpenSession, pipeline: Pipeline) -> ReadyMessage:
        return ReadyMessage(
            session=opened.id,
            mode=self._rules.mode,
            detector=pipeline.name,
            model=pipeline.network.name,
            provider=pipeline.network.provider,
            limits=self._service.limits,
        )

    async def _answer(self) -> None:
        """Answers frames one at a time and in order, then, after `end`, tells the summary and closes."""
        while not self._rules.finished:
            frame = self._rules.take()
            if frame is not None:
                await self._send(await self._answer_to(frame))
                continue
            self._news.clear()
            await self._news.wait()
        # Whoever has seen the summary finds the place free.
        self._release()
        await self._send(self._rules.summary(time.monotonic()))
        await self._socket.close()

    async def _answer_to(self, frame: IncomingFrame) -> Message:
        session = self._ensure_session().session
        try:
            runner = self._service.loaded.runner
            processed = await runner.run(session, EncodedFrame(frame.data, frame.timestamp, frame.arrived))
        except Exception as error:
            if not isinstance(error, LanestreamError):
                _log.exception("frame %d failed", frame.seq)
            self._rules.settle(answered=False)
            return error_message(error, seq=frame.seq)
        self._rules.settle(answered=True)
        return lanes_message(
            processed,
            seq=frame.seq,
            timestamp=frame.timestamp,
            dropped=self._rules.dropped,
            camera=self._rules.options.camera,
        )

    def _release(self) -> None:
        if self._opened is None:
            return
        self._service.sessions.close(self._opened)
        count = self._rules.summary(time.monotonic())
        _log.info(
            "stream %s closed after %.1f s: %d frames, %d answered, %d failed, %d dropped",
            *(self._opened.id, count.duration_s, count.frames, count.answered, count.failed, count.dropped),
        )
        self._opened = None

    async def _send(self, message: Message) -> None:
        await self._socket.send_text(message.model_dump_json())

    async def _close_with(self, error: Exception) -> None:
        told = error_message(error, fatal=True)
        reason = told.message.encode()[:_MOST_REASON_BYTES].decode(errors="ignore")
        try:
            await self._send(told)
            await self._socket.close(answer_to(error).close_code, reason)
        except (WebSocketDisconnect, RuntimeError):
            _log.debug("the client was gone before it could be told: %s", told.message)
