"""Opens, resumes and closes the sessions of a process, within its limits."""

from __future__ import annotations

import asyncio
import hashlib
import logging
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal

from lanestream.errors import BusyError, StoreError
from lanestream.streaming.record import SessionRecord
from lanestream.streaming.store import Entry, SessionStore

if TYPE_CHECKING:
    from lanestream.protocol import DetectorName, StartMessage
    from lanestream.streaming.caller import Caller
    from lanestream.workers.pool import Camera, WorkerPool

_log = logging.getLogger(__name__)

# How long a new socket waits for the old one's frame in work before it takes the session as it was saved.
_EVICTION_S: Final = 2.0
# What a replica that was lost may have named in the frames since it last saved.
_IDS_LOST: Final = 8

Resumption = Literal["resumed", "unknown"]


@dataclass(frozen=True)
class SessionLimits:
    """How many sessions at a time, in all and by one caller, how long they live, and how they are saved (seconds).

    A session lives for `session_s`, on however many sockets, and for `resume_s` after its last one. While it is used it
    is saved every `save_s` at most.
    """

    sessions: int = 64
    sessions_per_caller: int | None = None
    session_s: float = 86_400.0
    resume_s: float = 60.0
    idle_s: float = 60.0
    save_s: float = 0.25


@dataclass(eq=False)
class OpenSession:
    """A session with a socket, or with a single image: the name that its client knows it by, and whose it is.

    `token` opens it again; None where nobody was told one. `last_seq` is the last frame that it has answered for, and
    `working` whether a frame is being worked on, when its state is nobody else's business. `resumption` tells how a
    wish to resume ended; None where there was none.
    """

    id: str
    camera: Camera
    caller: Caller
    born: float
    token: str | None = None
    last_seq: int | None = None
    resumption: Resumption | None = None
    stream_s: float = 0.0
    working: bool = False
    on_evict: Callable[[], None] | None = None
    owner: str = field(default_factory=lambda: secrets.token_hex(8))
    saved_at: float = 0.0
    saving: asyncio.Task[None] | None = None
    later: asyncio.TimerHandle | None = None
    changed: bool = False
    gone: asyncio.Event = field(default_factory=asyncio.Event)

    @property
    def key(self) -> str | None:
        """What the store knows it by: the store never sees a token."""
        return None if self.token is None else hashlib.sha256(self.token.encode()).hexdigest()

    def evict(self) -> None:
        """Tells its socket to go."""
        if self.on_evict is not None:
            self.on_evict()


class SessionRegistry:
    """The open sessions. Belongs to the event loop. `wall` tells the time of day that replicas share, in seconds."""

    def __init__(self, limits: SessionLimits, store: SessionStore, wall: Callable[[], float] = time.time) -> None:
        self._limits = limits
        self._store = store
        self._wall = wall
        self._open: set[OpenSession] = set()
        self._by_key: dict[str, OpenSession] = {}
        self._store_works = True

    def __len__(self) -> int:
        return len(self._open)

    def age_s(self, opened: OpenSession) -> float:
        """How long ago a session began, on whichever replica."""
        return self._wall() - opened.born

    def check_limits(self, caller: Caller) -> None:
        """Raises BusyError where no session more can be opened, in all or by `caller`."""
        limits = self._limits
        if len(self._open) >= limits.sessions:
            raise BusyError(f"all {limits.sessions} sessions are taken", "try again later")
        if limits.sessions_per_caller is None:
            return
        if sum(opened.caller.quota == caller.quota for opened in self._open) >= limits.sessions_per_caller:
            raise BusyError(
                f"you have {limits.sessions_per_caller} sessions, which is the most for one caller", "end one of them"
            )

    def open(
        self,
        runner: WorkerPool,
        caller: Caller,
        horizon: float | None = None,
        detector: DetectorName | None = None,
        name: str | None = None,
    ) -> OpenSession:
        """A new session without a token; `horizon` as a share of the image height.

        Raises BusyError at a limit, NoDetectorError where `detector` is not offered.
        """
        self.check_limits(caller)
        camera = runner.open_camera(horizon, detector)
        opened = OpenSession(name or secrets.token_hex(8), camera, caller, self._wall())
        self._open.add(opened)
        return opened

    @contextmanager
    def opened(
        self, runner: WorkerPool, caller: Caller, horizon: float | None = None, detector: DetectorName | None = None
    ) -> Iterator[OpenSession]:
        """A session for the length of a `with` block."""
        opened = self.open(runner, caller, horizon, detector)
        try:
            yield opened
        finally:
            self._open.discard(opened)

    async def start(self, runner: WorkerPool, caller: Caller, message: StartMessage) -> OpenSession:
        """The session that `message` asks for: that of its token, where it lives and is the caller's, else a new one.

        Raises BusyError at a limit, NoDetectorError where its detector is not offered.
        """
        owner = secrets.token_hex(8)
        record = None if message.resume_token is None else await self._taken(message.resume_token, caller, owner)
        opened = self.open(runner, caller, message.horizon, message.detector, message.session)
        opened.owner = owner
        opened.token = secrets.token_urlsafe(32)
        if message.resume_token is not None:
            opened.resumption = "unknown"
        if record is not None and self._restored(opened, record):
            opened.token, opened.resumption = message.resume_token, "resumed"
        if opened.key is not None:
            self._by_key[opened.key] = opened
        # From now on any replica can take it over, whatever happens to this one.
        await self._save(opened, self._record(opened, clean=False), self._limits.resume_s + self._limits.idle_s)
        return opened

    def note(self, opened: OpenSession) -> None:
        """Tells that a session has changed: it is saved at once, or once the last time is long enough ago."""
        opened.changed = opened.saving is not None
        if opened.token is None or opened.saving is not None or opened.later is not None or opened.working:
            return
        wait = opened.saved_at + self._limits.save_s - time.monotonic()
        if wait > 0.0:
            opened.later = asyncio.get_running_loop().call_later(wait, self._note_again, opened)
            return
        opened.saved_at = time.monotonic()
        record = self._record(opened, clean=False)
        opened.saving = asyncio.create_task(self._save_beside(opened, record))

    async def close(self, opened: OpenSession, *, for_good: bool) -> None:
        """Lets go of a session whose socket is gone; it can be resumed for a while, unless it ended `for_good`."""
        if opened.later is not None:
            opened.later.cancel()
        try:
            if opened.saving is not None:
                await opened.saving
            if for_good:
                await self._forget(opened)
            else:
                await self._save(opened, self._record(opened, clean=True), self._limits.resume_s)
        finally:
            self._open.discard(opened)
            if opened.key is not None and self._by_key.get(opened.key) is opened:
                del self._by_key[opened.key]
            opened.gone.set()

    async def _taken(self, token: str, caller: Caller, owner: str) -> SessionRecord | None:
        """The record of the session of `token`, owned by `owner` from now on; a socket that still has it has to go."""
        key = hashlib.sha256(token.encode()).hexdigest()
        holder = self._by_key.get(key)
        if holder is not None and holder.caller.identity == caller.identity:
            holder.evict()
            with suppress(TimeoutError):
                await asyncio.wait_for(holder.gone.wait(), _EVICTION_S)
        try:
            data = await self._store.take(key, caller.identity, owner)
        except StoreError as error:
            self._store_failed(error)
            return None
        record = None if data is None else SessionRecord.of_bytes(data)
        if record is None or self._wall() - record.born >= self._limits.session_s:
            return None
        return record

    def _restored(self, opened: OpenSession, record: SessionRecord) -> bool:
        """Whether `opened` now goes on where `record` ends."""
        try:
            opened.camera.restore(record.state, 0 if record.clean else _IDS_LOST)
        except ValueError:
            _log.warning("session %s was saved in a way that is not understood; it begins anew", record.session)
            return False
        opened.id, opened.born, opened.last_seq = record.session, record.born, record.last_seq
        opened.stream_s = record.stream_s + max(0.0, self._wall() - record.saved)
        return True

    def _record(self, opened: OpenSession, *, clean: bool) -> SessionRecord:
        return SessionRecord(
            session=opened.id,
            born=opened.born,
            saved=self._wall(),
            stream_s=opened.stream_s,
            last_seq=opened.last_seq,
            clean=clean,
            state=opened.camera.state,
        )

    def _note_again(self, opened: OpenSession) -> None:
        opened.later = None
        self.note(opened)

    async def _save_beside(self, opened: OpenSession, record: SessionRecord) -> None:
        try:
            await self._save(opened, record, self._limits.resume_s + self._limits.idle_s)
        finally:
            opened.saving = None
        if opened.changed:
            self.note(opened)

    async def _save(self, opened: OpenSession, record: SessionRecord, ttl_s: float) -> None:
        if opened.key is None:
            return
        entry = Entry(opened.caller.identity, opened.owner, record.to_bytes())
        try:
            if not await self._store.save(opened.key, entry, ttl_s):
                opened.evict()
        except StoreError as error:
            self._store_failed(error)
        else:
            self._store_works = True

    async def _forget(self, opened: OpenSession) -> None:
        if opened.key is None:
            return
        try:
            await self._store.forget(opened.key, opened.owner)
        except StoreError as error:
            self._store_failed(error)

    def _store_failed(self, error: StoreError) -> None:
        """Logs that sessions can't be saved or resumed, once until they can be again."""
        if self._store_works:
            _log.warning("sessions are not saved and can't be resumed elsewhere: %s", error)
        self._store_works = False
