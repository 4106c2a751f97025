"""Opens, resumes, saves and closes the sessions of a process, within its limits."""

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

from lanestream.errors import BusyError, StoreError, TooOldError
from lanestream.streaming.record import SessionRecord
from lanestream.streaming.store import SessionStore, StoredSession

if TYPE_CHECKING:
    from lanestream.protocol import DetectorName, StartMessage
    from lanestream.workers.pool import SessionHandle, WorkerPool

_log = logging.getLogger(__name__)

# How long a new socket waits for the old one to finish its frame. After that it resumes the last saved state.
_EVICTION_S: Final = 2.0
# A replica that crashed may have assigned this many track ids since it last saved; they are not assigned again.
_UNSAVED_IDS: Final = 8

ResumeOutcome = Literal["resumed", "unknown"]


@dataclass(frozen=True)
class Caller:
    """The caller behind a request or stream: `identity` owns sessions, `quota` is the name they are counted under.

    With an API key both are the key's name. Without keys all callers share one identity, and each host has its own
    quota.
    """

    identity: str
    quota: str


@dataclass(frozen=True)
class SessionLimits:
    """How many sessions may be open, in total and per caller, how long they live, and how often they are saved.

    A session lives for at most `session_s` seconds over all its sockets, and for `resume_s` after the last one closes.
    An active session is saved every `save_s` seconds at most.
    """

    sessions: int = 64
    sessions_per_caller: int | None = None
    session_s: float = 86_400.0
    resume_s: float = 60.0
    idle_s: float = 60.0
    save_s: float = 0.25


@dataclass(eq=False)
class OpenSession:
    """A session in use by a socket or a single image: its name, its camera state and the caller it belongs to.

    `token` resumes it; None if the client was given none. `last_seq` is the last answered frame. The state of `handle`
    may be read only while `processing` is False. `resume_outcome` is None unless the client asked to resume a session.
    """

    id: str
    handle: SessionHandle
    caller: Caller
    born: float
    token: str | None = None
    last_seq: int | None = None
    resume_outcome: ResumeOutcome | None = None
    stream_s: float = 0.0
    processing: bool = False
    on_evict: Callable[[], None] | None = None
    owner: str = field(default_factory=lambda: secrets.token_hex(8))
    saved_at: float = 0.0
    save_task: asyncio.Task[None] | None = None
    save_timer: asyncio.TimerHandle | None = None
    changed: bool = False
    closed: asyncio.Event = field(default_factory=asyncio.Event)

    @property
    def resumed(self) -> bool:
        """Whether the session continues an earlier one."""
        return self.resume_outcome == "resumed"

    @property
    def key(self) -> str | None:
        """The key in the store, which never sees a token; None without a token."""
        return None if self.token is None else _store_key(self.token)

    def evict(self) -> None:
        """Asks the session's socket to close."""
        if self.on_evict is not None:
            self.on_evict()


class SessionRegistry:
    """The open sessions of one event loop. `wall_clock` returns the time of day in seconds, shared by all replicas."""

    def __init__(self, limits: SessionLimits, store: SessionStore, wall_clock: Callable[[], float] = time.time) -> None:
        self._limits = limits
        self._store = store
        self._wall_clock = wall_clock
        self._open: set[OpenSession] = set()
        self._by_key: dict[str, OpenSession] = {}
        self._store_reachable = True

    def __len__(self) -> int:
        return len(self._open)

    def life_s_left(self, session: OpenSession) -> float:
        """Returns the seconds until a session reaches its maximum age, counted from its first socket on any replica."""
        return self._limits.session_s - (self._wall_clock() - session.born)

    def check_age(self, session: OpenSession) -> None:
        """Raises TooOldError if the session has reached its maximum age."""
        if self.life_s_left(session) <= 0.0:
            raise TooOldError(f"the session reached its maximum age of {self._limits.session_s:g} s", "open a new one")

    def check_limits(self, caller: Caller) -> None:
        """Raises BusyError if no further session can be opened, in total or for `caller`."""
        limits = self._limits
        if len(self._open) >= limits.sessions:
            raise BusyError(f"all {limits.sessions} sessions are in use", "try again later")
        if limits.sessions_per_caller is None:
            return
        if sum(session.caller.quota == caller.quota for session in self._open) >= limits.sessions_per_caller:
            raise BusyError(
                f"you already have {limits.sessions_per_caller} sessions, the limit for one caller", "end one of them"
            )

    def open(
        self,
        pool: WorkerPool,
        caller: Caller,
        horizon: float | None = None,
        detector: DetectorName | None = None,
        name: str | None = None,
    ) -> OpenSession:
        """Opens a session that can't be resumed. `horizon` is a fraction of the image height.

        Raises BusyError at a limit, and NoDetectorError if `detector` is not loaded.
        """
        self.check_limits(caller)
        handle = pool.open_session(horizon, detector)
        session = OpenSession(name or secrets.token_hex(8), handle, caller, self._wall_clock())
        self._open.add(session)
        return session

    @contextmanager
    def temporary(
        self, pool: WorkerPool, caller: Caller, horizon: float | None = None, detector: DetectorName | None = None
    ) -> Iterator[OpenSession]:
        """Opens a session for the duration of a `with` block. Raises BusyError and NoDetectorError."""
        session = self.open(pool, caller, horizon, detector)
        try:
            yield session
        finally:
            self._open.discard(session)

    async def start(self, pool: WorkerPool, caller: Caller, message: StartMessage) -> OpenSession:
        """Resumes the session of the message's token if it still exists and belongs to `caller`; else opens a new one.

        Raises BusyError at a limit, and NoDetectorError if the requested detector is not loaded.
        """
        owner = secrets.token_hex(8)
        record = None if message.resume_token is None else await self._take_over(message.resume_token, caller, owner)
        session = self.open(pool, caller, message.horizon, message.detector, message.session)
        session.owner = owner
        session.token = secrets.token_urlsafe(32)
        if message.resume_token is not None:
            session.resume_outcome = "unknown"
        if record is not None and self._restore(session, record):
            session.token, session.resume_outcome = message.resume_token, "resumed"
        if session.key is not None:
            self._by_key[session.key] = session
        # From now on any replica can resume the session, even if this one crashes.
        await self._save(session, self._record(session, clean=False), self._limits.resume_s + self._limits.idle_s)
        return session

    def schedule_save(self, session: OpenSession) -> None:
        """Saves a changed session in the background: now, or `save_s` after the last time."""
        session.changed = session.save_task is not None
        if session.token is None or session.save_task is not None or session.save_timer is not None:
            return
        if session.processing:
            return
        delay = session.saved_at + self._limits.save_s - time.monotonic()
        if delay > 0.0:
            session.save_timer = asyncio.get_running_loop().call_later(delay, self._save_timer_fired, session)
            return
        session.saved_at = time.monotonic()
        record = self._record(session, clean=False)
        session.save_task = asyncio.create_task(self._save_in_background(session, record))

    async def close(self, session: OpenSession, *, resumable: bool) -> None:
        """Closes a session whose socket has closed. A `resumable` one is kept for `resume_s`; another is deleted."""
        if session.save_timer is not None:
            session.save_timer.cancel()
        try:
            if session.save_task is not None:
                await session.save_task
            if resumable:
                await self._save(session, self._record(session, clean=True), self._limits.resume_s)
            else:
                await self._delete(session)
        finally:
            self._open.discard(session)
            if session.key is not None and self._by_key.get(session.key) is session:
                del self._by_key[session.key]
            session.closed.set()

    async def _take_over(self, token: str, caller: Caller, owner: str) -> SessionRecord | None:
        """Makes `owner` the owner of the token's session and returns its record; evicts a socket that still uses it."""
        key = _store_key(token)
        holder = self._by_key.get(key)
        if holder is not None and holder.caller.identity == caller.identity:
            holder.evict()
            with suppress(TimeoutError):
                await asyncio.wait_for(holder.closed.wait(), _EVICTION_S)
        try:
            data = await self._store.take_over(key, caller.identity, owner)
        except StoreError as error:
            self._report_store_failure(error)
            return None
        record = None if data is None else SessionRecord.from_bytes(data)
        if record is None or self._wall_clock() - record.born >= self._limits.session_s:
            return None
        return record

    def _restore(self, session: OpenSession, record: SessionRecord) -> bool:
        """Puts the state of `record` into `session`. Returns False if the state can't be used."""
        try:
            session.handle.restore(record.state, 0 if record.clean else _UNSAVED_IDS)
        except ValueError:
            _log.warning("the saved state of session %s can't be used; it starts over", record.session)
            return False
        session.id, session.born, session.last_seq = record.session, record.born, record.last_seq
        session.stream_s = record.stream_s + max(0.0, self._wall_clock() - record.saved)
        return True

    def _record(self, session: OpenSession, *, clean: bool) -> SessionRecord:
        return SessionRecord(
            session=session.id,
            born=session.born,
            saved=self._wall_clock(),
            stream_s=session.stream_s,
            last_seq=session.last_seq,
            clean=clean,
            state=session.handle.state,
        )

    def _save_timer_fired(self, session: OpenSession) -> None:
        session.save_timer = None
        self.schedule_save(session)

    async def _save_in_background(self, session: OpenSession, record: SessionRecord) -> None:
        try:
            await self._save(session, record, self._limits.resume_s + self._limits.idle_s)
        finally:
            session.save_task = None
        if session.changed:
            self.schedule_save(session)

    async def _save(self, session: OpenSession, record: SessionRecord, ttl_s: float) -> None:
        if session.key is None:
            return
        stored = StoredSession(session.caller.identity, session.owner, record.to_bytes())
        try:
            if not await self._store.save(session.key, stored, ttl_s):
                session.evict()
        except StoreError as error:
            self._report_store_failure(error)
        else:
            self._store_reachable = True

    async def _delete(self, session: OpenSession) -> None:
        if session.key is None:
            return
        try:
            await self._store.delete(session.key, session.owner)
        except StoreError as error:
            self._report_store_failure(error)

    def _report_store_failure(self, error: StoreError) -> None:
        """Logs that sessions can't be saved or resumed: once, until the store works again."""
        if self._store_reachable:
            _log.warning("sessions are not saved and can't be resumed elsewhere: %s", error)
        self._store_reachable = False


def _store_key(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
