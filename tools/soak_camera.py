"""One camera of the soak: it streams, stalls, disconnects, resumes and sends invalid data, and checks every answer.

A violation of what the service guarantees to a camera is a `GuaranteeError`.
"""

from __future__ import annotations

import asyncio
import json
import random
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any, Final

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

SUBPROTOCOL: Final = "lanestream.v1"
FRAME_S: Final = 0.04
_ANSWER_TIMEOUT_S: Final = 30.0
# A track ends after this gap between frames, see `_COAST_S` of lanestream.tracking.tracker.
_COAST_S: Final = 0.7
# From this frame on, track ids must not change.
_STABLE_FROM_SEQ: Final = 10
_NOT_IMAGES: Final = (b"", b"not an image", b"\xff\xd8\xff\xe0 cut", bytes(100_000))


class GuaranteeError(AssertionError):
    """The service violated a guarantee."""


@dataclass
class SoakCamera:
    """A camera that always sends the same `image` (a JPEG file), so that the track ids must never change."""

    name: str
    url: str
    mode: str
    image: bytes
    too_large: bytes
    random: random.Random
    max_bytes: int = 8 << 20
    token: str | None = None
    seq: int = 0
    pending: deque[int] = field(default_factory=deque)
    answered: int = -1
    ids: dict[int, int] = field(default_factory=dict)
    last_timestamp: float = 0.0
    counts: Counter[str] = field(default_factory=Counter)
    sent_on_socket: int = 0

    async def run(self, until: float) -> None:
        """Runs until the monotonic time `until`, and connects again whenever a socket was closed."""
        while time.monotonic() < until:
            try:
                async with connect(
                    f"{self.url.replace('http', 'ws')}/v1/stream",
                    subprotocols=[SUBPROTOCOL],  # type: ignore[list-item]
                    compression=None,
                    close_timeout=1,
                ) as socket:
                    await self._on_socket(socket, until)
            except ConnectionClosed as closed:
                self._expect(closed.rcvd is not None and closed.rcvd.code in (1000, 1009), f"closed: {closed}")
            # Frames that were in flight when the socket closed are lost.
            self.counts["lost"] += len(self.pending)
            self.pending.clear()
            await asyncio.sleep(self.random.uniform(0.0, 0.5))

    async def _on_socket(self, socket: ClientConnection, until: float) -> None:
        await self._open(socket)
        while time.monotonic() < until:
            action = self.random.choices(
                (self._stream, self._bad_image, self._bad_message, self._stall, self._close, self._abort, self._end),
                weights=(60, 12, 8, 8, 4, 5, 3),
            )[0]
            if not await action(socket):
                return
        await self._end(socket)

    async def _open(self, socket: ClientConnection) -> None:
        start = {"type": "start", "mode": self.mode, "session": self.name}
        if self.token is not None:
            start["resume_token"] = self.token
        await socket.send(json.dumps(start))
        ready = await self._receive(socket)
        self._expect(ready["type"] == "ready", f"`start` was answered with {ready}")
        self._expect(ready["resumed"] == (self.token is not None), f"the session was not resumed: {ready}")
        if ready["resumed"]:
            self.counts["resumed"] += 1
            last = -1 if ready["last_seq"] is None else ready["last_seq"]
            self._expect(self.answered <= last < self.seq, f"resumed at {last}, answered was {self.answered}")
            self.answered = last
        else:
            self.counts["opened"] += 1
            self.answered, self.seq, self.ids = -1, 0, {}
        self.token = ready["resume_token"]
        self.sent_on_socket = 0

    async def _stream(self, socket: ClientConnection) -> bool:
        for _ in range(self.random.randint(1, 30)):
            for _ in range(self.random.randint(1, 4)):
                await self._send(socket, self.image)
            await self._settle(socket)
        return True

    async def _bad_image(self, socket: ClientConnection) -> bool:
        """Sends an invalid or too large image, which costs only this frame."""
        await self._send(socket, self.random.choice((*_NOT_IMAGES, self.too_large)))
        await self._send(socket, self.image)
        await self._settle(socket)
        return True

    async def _bad_message(self, socket: ClientConnection) -> bool:
        """Sends an invalid message, or sometimes one that is so large that the service closes the socket."""
        if self.random.random() < 0.2:
            await socket.send(bytes(2 * self.max_bytes + 1))
            await self._receive(socket)
            raise GuaranteeError(f"{self.name}: a message that is far too large was accepted")
        await socket.send(self.random.choice(("{", "[]", '{"type": "lanes"}', '{"type": "frame", "seq": -1}', "\x00")))
        reply = await self._receive(socket)
        self._expect(
            reply.get("code") == "bad_message" and not reply["fatal"], f"an invalid message was answered with {reply}"
        )
        return True

    async def _stall(self, socket: ClientConnection) -> bool:
        """Sends frames and does not read for a while."""
        for _ in range(3):
            await self._send(socket, self.image)
        await asyncio.sleep(self.random.uniform(0.1, 2.0))
        await self._settle(socket)
        return True

    async def _close(self, socket: ClientConnection) -> bool:
        await socket.close()
        return False

    async def _abort(self, socket: ClientConnection) -> bool:
        """Breaks the connection without closing it, while frames are in flight."""
        for _ in range(self.random.randint(0, 3)):
            await self._send(socket, self.image)
        socket.transport.abort()
        return False

    async def _end(self, socket: ClientConnection) -> bool:
        await self._settle(socket)
        await socket.send('{"type": "end"}')
        summary = await self._receive(socket)
        self._expect(summary["type"] == "summary", f"`end` was answered with {summary}")
        frames = summary["answered"] + summary["failed"] + summary["dropped"]
        self._expect(summary["frames"] == self.sent_on_socket == frames, f"sent {self.sent_on_socket}: {summary}")
        self.token = None
        return False

    async def _send(self, socket: ClientConnection, data: bytes) -> None:
        await socket.send(json.dumps({"type": "frame", "seq": self.seq, "timestamp": FRAME_S * self.seq}))
        await socket.send(data)
        self.pending.append(self.seq)
        self.counts["sent"] += 1
        self.seq += 1
        self.sent_on_socket += 1

    async def _settle(self, socket: ClientConnection) -> None:
        """Reads until all frames are answered or dropped."""
        while self.pending:
            reply = await self._receive(socket)
            self._expect(
                reply["type"] in ("lanes", "error") and not reply.get("fatal"), f"a frame was answered with {reply}"
            )
            seq = reply["seq"]
            self._expect(seq in self.pending, f"frame {seq} was answered, but only {list(self.pending)} are pending")
            while self.pending[0] != seq:
                self._expect(self.mode == "latest", f"frame {self.pending[0]} was dropped in mode `all`")
                self.counts["dropped"] += 1
                self.pending.popleft()
            self.pending.popleft()
            self.counts["lanes" if reply["type"] == "lanes" else reply["code"]] += 1
            if reply["type"] == "lanes":
                self.answered = seq
                self._check_ids(reply)

    def _check_ids(self, answer: dict[str, Any]) -> None:
        """Checks that a boundary keeps its track id from answer to answer, even over a resume.

        After a gap longer than the tracker predicts boundaries without seeing them, ids may be new.
        """
        gap_s, self.last_timestamp = answer["timestamp"] - self.last_timestamp, answer["timestamp"]
        if gap_s > _COAST_S:
            self.ids = {}
        ids = {lane["position"]: lane["track_id"] for lane in answer["lanes"] if lane["position"] in (-1, 1)}
        same = all(ids[position] == self.ids.get(position, ids[position]) for position in ids)
        self._expect(same, f"at frame {answer['seq']} the ids {self.ids} became {ids}")
        self.ids = ids if answer["seq"] >= _STABLE_FROM_SEQ else {}

    async def _receive(self, socket: ClientConnection) -> dict[str, Any]:
        message: dict[str, Any] = json.loads(await asyncio.wait_for(socket.recv(), _ANSWER_TIMEOUT_S))
        return message

    def _expect(self, condition: bool, violation: str) -> None:
        if not condition:
            raise GuaranteeError(f"{self.name} ({self.mode}): {violation}")
