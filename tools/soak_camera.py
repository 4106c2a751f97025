"""One camera of the soak: it streams, stalls, leaves, comes back and sends rubbish, and checks every answer.

What a service promises and a camera can see is checked here; a broken promise is a `BrokenPromiseError`.
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

from lanestream.tracking import TrackerSettings

SUBPROTOCOL: Final = "lanestream.v1"
FRAME_S: Final = 0.04
_ANSWER_S: Final = 30.0
_NAMED: Final = 10
_NOT_IMAGES: Final = (b"", b"no image at all", b"\xff\xd8\xff\xe0 cut", bytes(100_000))


class BrokenPromiseError(AssertionError):
    """A promise that the service did not keep."""


@dataclass
class Camera:
    """A camera that always shows the same `picture` (a JPEG file), so that its boundaries' ids must never change."""

    name: str
    url: str
    mode: str
    picture: bytes
    too_large: bytes
    random: random.Random
    max_bytes: int = 8 << 20
    token: str | None = None
    seq: int = 0
    pending: deque[int] = field(default_factory=deque)
    answered: int = -1
    ids: dict[int, int] = field(default_factory=dict)
    told_s: float = 0.0
    counts: Counter[str] = field(default_factory=Counter)
    sent_here: int = 0

    async def live(self, until: float) -> None:
        """Lives until the monotonic time `until`, on as many sockets as it takes."""
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
            # What was in flight when the socket went is lost, and both sides know it.
            self.counts["lost"] += len(self.pending)
            self.pending.clear()
            await asyncio.sleep(self.random.uniform(0.0, 0.5))

    async def _on_socket(self, socket: ClientConnection, until: float) -> None:
        await self._open(socket)
        while time.monotonic() < until:
            act = self.random.choices(
                (self._stream, self._rubbish, self._nonsense, self._stall, self._leave, self._vanish, self._end),
                weights=(60, 12, 8, 8, 4, 5, 3),
            )[0]
            if not await act(socket):
                return
        await self._end(socket)

    async def _open(self, socket: ClientConnection) -> None:
        start = {"type": "start", "mode": self.mode, "session": self.name}
        if self.token is not None:
            start["resume_token"] = self.token
        await socket.send(json.dumps(start))
        ready = await self._heard(socket)
        self._expect(ready["type"] == "ready", f"`start` was answered with {ready}")
        self._expect(ready["resumed"] == (self.token is not None), f"a living session was not resumed: {ready}")
        if ready["resumed"]:
            self.counts["resumed"] += 1
            last = -1 if ready["last_seq"] is None else ready["last_seq"]
            self._expect(self.answered <= last < self.seq, f"resumed at {last}, heard of {self.answered}")
            self.answered = last
        else:
            self.counts["opened"] += 1
            self.answered, self.seq, self.ids = -1, 0, {}
        self.token = ready["resume_token"]
        self.sent_here = 0

    async def _stream(self, socket: ClientConnection) -> bool:
        for _ in range(self.random.randint(1, 30)):
            for _ in range(self.random.randint(1, 4)):
                await self._send(socket, self.picture)
            await self._settle(socket)
        return True

    async def _rubbish(self, socket: ClientConnection) -> bool:
        """Images that are none, or too large: each costs itself."""
        await self._send(socket, self.random.choice((*_NOT_IMAGES, self.too_large)))
        await self._send(socket, self.picture)
        await self._settle(socket)
        return True

    async def _nonsense(self, socket: ClientConnection) -> bool:
        """Messages that are none, and now and then one that is far too large, which costs the socket."""
        if self.random.random() < 0.2:
            await socket.send(bytes(2 * self.max_bytes + 1))
            await self._heard(socket)
            raise BrokenPromiseError(f"{self.name}: a message far too large was taken")
        await socket.send(self.random.choice(("{", "[]", '{"type": "lanes"}', '{"type": "frame", "seq": -1}', "\x00")))
        told = await self._heard(socket)
        self._expect(told.get("code") == "bad_message" and not told["fatal"], f"nonsense was answered with {told}")
        return True

    async def _stall(self, socket: ClientConnection) -> bool:
        """Sends and does not read for a while."""
        for _ in range(3):
            await self._send(socket, self.picture)
        await asyncio.sleep(self.random.uniform(0.1, 2.0))
        await self._settle(socket)
        return True

    async def _leave(self, socket: ClientConnection) -> bool:
        await socket.close()
        return False

    async def _vanish(self, socket: ClientConnection) -> bool:
        """Goes in the middle of things, without a word."""
        for _ in range(self.random.randint(0, 3)):
            await self._send(socket, self.picture)
        socket.transport.abort()
        return False

    async def _end(self, socket: ClientConnection) -> bool:
        await self._settle(socket)
        await socket.send('{"type": "end"}')
        summary = await self._heard(socket)
        self._expect(summary["type"] == "summary", f"`end` was answered with {summary}")
        frames = summary["answered"] + summary["failed"] + summary["dropped"]
        self._expect(summary["frames"] == self.sent_here == frames, f"{self.sent_here} frames were sent: {summary}")
        self.token = None
        return False

    async def _send(self, socket: ClientConnection, data: bytes) -> None:
        await socket.send(json.dumps({"type": "frame", "seq": self.seq, "timestamp": FRAME_S * self.seq}))
        await socket.send(data)
        self.pending.append(self.seq)
        self.counts["sent"] += 1
        self.seq += 1
        self.sent_here += 1

    async def _settle(self, socket: ClientConnection) -> None:
        """Reads until nothing is owed any more."""
        while self.pending:
            told = await self._heard(socket)
            self._expect(
                told["type"] in ("lanes", "error") and not told.get("fatal"), f"a frame was answered with {told}"
            )
            seq = told["seq"]
            self._expect(seq in self.pending, f"frame {seq} was answered and not owed; owed were {list(self.pending)}")
            while self.pending[0] != seq:
                self._expect(self.mode == "latest", f"frame {self.pending[0]} was left out in mode `all`")
                self.counts["dropped"] += 1
                self.pending.popleft()
            self.pending.popleft()
            self.counts["lanes" if told["type"] == "lanes" else told["code"]] += 1
            if told["type"] == "lanes":
                self.answered = seq
                self._check_ids(told)

    def _check_ids(self, told: dict[str, Any]) -> None:
        """A boundary that is told in two answers in a row, on whichever sockets, has one id.

        Where there were no answers for longer than boundaries are followed unseen, they are new ones.
        """
        unseen_s, self.told_s = told["timestamp"] - self.told_s, told["timestamp"]
        if unseen_s > TrackerSettings.coast_s:
            self.ids = {}
        ids = {lane["position"]: lane["track_id"] for lane in told["lanes"] if lane["position"] in (-1, 1)}
        same = all(ids[position] == self.ids.get(position, ids[position]) for position in ids)
        self._expect(same, f"at frame {told['seq']} the ids {self.ids} became {ids}")
        # A stream names its boundaries for good once it has seen them a few times.
        self.ids = ids if told["seq"] >= _NAMED else {}

    async def _heard(self, socket: ClientConnection) -> dict[str, Any]:
        message: dict[str, Any] = json.loads(await asyncio.wait_for(socket.recv(), _ANSWER_S))
        return message

    def _expect(self, kept: bool, broken: str) -> None:
        if not kept:
            raise BrokenPromiseError(f"{self.name} ({self.mode}): {broken}")
