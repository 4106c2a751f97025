"""Opens, resumes, saves and closes the sessions of a process, within its limits."""

from __future__ import annotations

import asyncio
import hashlib
import logging
import math
import secrets
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from contextvars import Context
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, Literal

from lanestream.errors import BusyError, EvictedError, StoreError, TooOldError
from lanestream.session import DEFAULT_SESSION, SessionOptions
from lanestream.streaming.record import SessionRecord
from lanestream.streaming.store import SessionStore, StoredSession
from lanestream.streaming.token_bucket import TokenBuckets

if TYPE_CHECKING:
    from lanestream.protocol import StartMessage
    from lanestream.streaming.store import TakenSession
    from lanestream.workers.pool import SessionHandle, WorkerPool

_log = logging.getLogger(__name__)

# How long a new socket waits for the old one to finish its frame. After that it resumes the last saved state.
_EVICTION_S: Final = 2.0
# A replica that crashed may have assigned this many track ids since it last saved; they are not assigned again.
_UNSAVED_IDS: Final = 8
# How often the ownership of open sessions in a shared store is renewed.
_RENEW_S: Final = 1.0
# The sessions that one caller may open per second, on average, and in a burst. Resumed ones do not count.
_OPENS_PER_S: Final = 100.0
_MOST_OPENS: Final = 400

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

    `born` and `stream_began` are when it was opened and when its stream's own clock was at zero, on the monotonic
    `clock`. `token` resumes it; None if the client was given none. `last_seq` is the last answered frame. The state of
    `handle` may be read only while `processing` is False. `resume_outcome` is None unless the client asked to resume a
    session.
    """

    id: str
    handle: SessionHandle
    caller: Caller
    clock: Callable[[], float]
    born: float
    stream_began: float
    token: str | None = None
    last_seq: int | None = None
    resume_outcome: ResumeOutcome | None = None
    processing: bool = False
    evicted: bool = False
    on_evict: Callable[[], None] | None = None
    owner: str = field(default_factory=lambda: secrets.token_hex(8))
    saved_at: float = -math.inf
    save_task: asyncio.Task[None] | None = None
    save_timer: asyncio.TimerHandle | None = None
    changed: bool = False
    closing: bool = False
    closed: asyncio.Event = field(default_factory=asyncio.Event)

    @property
    def resumed(self) -> bool:
        """Whether the session continues an earlier one."""
        return self.resume_outcome == "resumed"

    @property
    def key(self) -> str | None:
        """The key in the store, which never sees a token; None without a token."""
        return None if self.token is None else _store_key(self.token)

    @property
    def age_s(self) -> float:
        """The seconds since its first socket opened it, on any replica."""
        return self.clock() - self.born

    @property
    def stream_s(self) -> float:
        """The stream's own clock in seconds, which goes on from the value that was set last."""
        return self.clock() - self.stream_began

    @stream_s.setter
    def stream_s(self, seconds: float) -> None:
        self.stream_began = self.clock() - seconds

    def evict(self) -> None:
        """Asks the session's socket to close."""
        self.evicted = True
        if self.on_evict is not None:
            self.on_evict()


class SessionRegistry:
    """The open sessions of one event loop.

    `clock` returns monotonic seconds: within a process nothing depends on the time of day. `wall_clock` returns the
    time of day in seconds: from it follows how long ago another replica saved a session. `on_store_failure` is called
    for each operation of the store that failed.
    """

    def __init__(
        self,
        limits: SessionLimits,
        store: SessionStore,
        *,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
        on_store_failure: Callable[[], None] | None = None,
    ) -> None:
        self._limits = limits
        self._store = store
        self._clock = clock
        self._wall_clock = wall_clock
        self._on_store_failure = on_store_failure
        self._process = secrets.token_hex(8)
        self._open: set[OpenSession] = set()
        self._by_key: dict[str, OpenSession] = {}
        self._turns: dict[tuple[str, str], _Turn] = {}
        self._opens = TokenBuckets(_OPENS_PER_S, _MOST_OPENS / _OPENS_PER_S)
        self._store_reachable = True
        self._renewal: asyncio.Task[None] | None = None

    def __len__(self) -> int:
        return len(self._open)

    @property
    def store_reachable(self) -> bool:
        """Whether the last operation of the store succeeded.

        It is up to date within about two seconds if the store is shared, from the first stream on.
        """
        return self._store_reachable

    def life_s_left(self, session: OpenSession) -> float:
        """Returns the seconds until a session reaches its maximum age, counted from its first socket on any replica."""
        return self._limits.session_s - session.age_s

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
        options: SessionOptions = DEFAULT_SESSION,
        name: str | None = None,
    ) -> OpenSession:
        """Opens a session that can't be resumed.

        Raises BusyError at a limit, and NoDetectorError if the requested detector is not loaded.
        """
        self.check_limits(caller)
        bucket = self._opens.bucket(caller.quota, self._clock())
        if not bucket.covers(1.0, self._clock()):
            raise BusyError(f"you opened more than {_OPENS_PER_S:g} sessions per second", "try again in a second")
        session = self._add(pool, caller, options, name)
        bucket.spend(1.0)
        return session

    @contextmanager
    def temporary(
        self, pool: WorkerPool, caller: Caller, options: SessionOptions = DEFAULT_SESSION
    ) -> Iterator[OpenSession]:
        """Opens a session for one image, for the duration of a `with` block. Raises BusyError and NoDetectorError."""
        self.check_limits(caller)
        session = self._add(pool, caller, replace(options, single_image=True))
        try:
            yield session
        finally:
            self._open.discard(session)

    async def start(
        self, pool: WorkerPool, caller: Caller, message: StartMessage, options: SessionOptions = DEFAULT_SESSION
    ) -> OpenSession:
        """Resumes the session of the message's token if it still exists and belongs to `caller`; else opens a new one.

        Of several sockets that resume one session at the same time, the latest gets it. Raises EvictedError for the
        others, BusyError at a limit, and NoDetectorError if the requested detector is not loaded.
        """
        if self._store.shared and self._renewal is None:
            # Outside of the request that happens to be the first: its log records are about all sessions.
            self._renewal = asyncio.create_task(self._renew(), context=Context())
        if message.resume_token is None:
            session = self.open(pool, caller, options, message.session)
            return await self._begin(session, _Turn())
        async with self._turn(caller, message.resume_token) as turn:
            turn.check_latest()
            session = await self._resume(pool, caller, message, options, message.resume_token)
            return await self._begin(session, turn)

    def schedule_save(self, session: OpenSession) -> None:
        """Saves a changed session in the background: now, or `save_s` after the last time."""
        session.changed = session.save_task is not None
        if session.token is None or session.save_task is not None or session.save_timer is not None:
            return
        if session.processing or session.closing:
            return
        delay = session.saved_at + self._limits.save_s - self._clock()
        if delay > 0.0:
            session.save_timer = asyncio.get_running_loop().call_later(delay, self._save_timer_fired, session)
            return
        session.saved_at = self._clock()
        record = self._record(session, clean=False)
        session.save_task = asyncio.create_task(self._save_in_background(session, record))

    async def close(self, session: OpenSession, *, resumable: bool) -> None:
        """Closes a session whose socket has closed. A `resumable` one is kept for `resume_s`; another is deleted."""
        session.closing = True
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
            self._discard(session)

    async def stop(self) -> None:
        """Ends the task that renews the ownership of sessions. Call it before the store is closed."""
        if self._renewal is not None:
            self._renewal.cancel()
            await asyncio.wait([self._renewal])

    def _add(self, pool: WorkerPool, caller: Caller, options: SessionOptions, name: str | None = None) -> OpenSession:
        handle, now = pool.open_session(options), self._clock()
        session = OpenSession(name or secrets.token_hex(8), handle, caller, self._clock, born=now, stream_began=now)
        self._open.add(session)
        return session

    def _discard(self, session: OpenSession) -> None:
        """Forgets a session that no socket uses any more."""
        self._open.discard(session)
        if session.key is not None and self._by_key.get(session.key) is session:
            del self._by_key[session.key]
        session.closed.set()

    @asynccontextmanager
    async def _turn(self, caller: Caller, token: str) -> AsyncIterator[_Turn]:
        """Waits until no other socket of `caller` is resuming the session of `token`."""
        name = caller.identity, token
        turn = self._turns.setdefault(name, _Turn())
        turn.sockets += 1
        try:
            async with turn.lock:
                yield turn
        finally:
            turn.sockets -= 1
            if turn.sockets == 0:
                del self._turns[name]

    async def _resume(
        self, pool: WorkerPool, caller: Caller, message: StartMessage, options: SessionOptions, token: str
    ) -> OpenSession:
        """Returns the session of `token`, or a new one if it can't be resumed."""
        owner = secrets.token_hex(8)
        taken = await self._take_over(token, caller, owner)
        record = None if taken is None else self._read(taken.data)
        if taken is None or record is None:
            session = self.open(pool, caller, options, message.session)
            session.resume_outcome = "unknown"
            return session
        self.check_limits(caller)
        session = self._add(pool, caller, options, message.session)
        session.owner = owner
        if self._restore(session, record, 0 if record.clean and taken.latest else _UNSAVED_IDS):
            session.token, session.resume_outcome = token, "resumed"
        else:
            session.resume_outcome = "unknown"
        return session

    async def _begin(self, session: OpenSession, turn: _Turn) -> OpenSession:
        """Gives a session a token, and saves it so that any replica can resume it, even if this one crashes.

        Raises EvictedError if it was resumed elsewhere in the meantime.
        """
        session.token = session.token or secrets.token_urlsafe(32)
        self._by_key[_store_key(session.token)] = session
        try:
            record = self._record(session, clean=False)
            await self._save(session, record, self._limits.resume_s + self._limits.idle_s)
            if session.evicted:
                raise _evicted()
            turn.check_latest()
        except BaseException:
            self._discard(session)
            raise
        return session

    async def _take_over(self, token: str, caller: Caller, owner: str) -> TakenSession | None:
        """Makes `owner` the owner of the token's session and returns it; evicts a socket that still uses it."""
        key = _store_key(token)
        holder = self._by_key.get(key)
        if holder is not None and holder.caller.identity == caller.identity:
            holder.evict()
            with suppress(TimeoutError):
                await asyncio.wait_for(holder.closed.wait(), _EVICTION_S)
        try:
            return await self._store.take_over(key, caller.identity, owner)
        except StoreError as error:
            self._note_failure(error)
            return None

    def _read(self, data: bytes) -> SessionRecord | None:
        """Returns the record in `data`; None if it can't be read, or if its session is too old."""
        record = SessionRecord.from_bytes(data)
        if record is None or record.age_s + self._seconds_since(record) >= self._limits.session_s:
            return None
        return record

    def _restore(self, session: OpenSession, record: SessionRecord, ids_lost: int) -> bool:
        """Puts the state of `record` into `session`. Returns False if the state can't be used."""
        try:
            record.state.validate()
            session.handle.restore(record.state, ids_lost)
        except ValueError as error:
            _log.warning("the saved state of session %s can't be used, so it starts over: %s", record.session, error)
            return False
        elapsed = self._seconds_since(record)
        session.id, session.last_seq = record.session, record.last_seq
        session.born = self._clock() - record.age_s - elapsed
        session.stream_s = record.stream_s + elapsed
        return True

    def _seconds_since(self, record: SessionRecord) -> float:
        """Returns the seconds since `record` was saved, which are known only roughly if another process saved it.

        The clocks of two machines may differ, and one that is set jumps. So the result is never negative, nor longer
        than a record is kept.
        """
        if record.process == self._process:
            elapsed = self._clock() - record.clock_s
        else:
            elapsed = self._wall_clock() - record.saved_s
        return min(max(elapsed, 0.0), self._limits.resume_s + self._limits.idle_s)

    def _record(self, session: OpenSession, *, clean: bool) -> SessionRecord:
        return SessionRecord(
            session=session.id,
            process=self._process,
            clock_s=self._clock(),
            saved_s=self._wall_clock(),
            age_s=session.age_s,
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
        """Saves a session, and evicts it if someone else owns it now."""
        if session.key is None:
            return
        stored = StoredSession(session.caller.identity, session.caller.quota, session.owner, record.to_bytes())
        try:
            if not await self._store.save(session.key, stored, ttl_s):
                session.evict()
        except StoreError as error:
            self._note_failure(error)
        else:
            self._note_success()

    async def _delete(self, session: OpenSession) -> None:
        if session.key is None:
            return
        try:
            await self._store.delete(session.key, session.owner)
        except StoreError as error:
            self._note_failure(error)

    async def _renew(self) -> None:
        """Saves the open sessions of a shared store about once a second, even if they get no frames.

        So a socket learns soon that another replica resumed its session, the session does not expire while it is in
        use, and a store that lost it gets it again. Without sessions, only tests whether the store can be reached.
        """
        while True:
            await asyncio.sleep(_RENEW_S)
            try:
                for session in tuple(self._by_key.values()):
                    if self._clock() - session.saved_at >= _RENEW_S:
                        self.schedule_save(session)
                if not self._by_key:
                    await self._store.ping()
                    self._note_success()
            except StoreError as error:
                self._note_failure(error)
            except Exception:
                _log.exception("sessions were not renewed")

    def _note_failure(self, error: StoreError) -> None:
        """Counts a failure of the store. Logs it unless the last operation failed, too."""
        if self._store_reachable:
            _log.warning(
                "sessions are not saved and can't be resumed elsewhere: %s", error, extra={"event": "store_lost"}
            )
        self._store_reachable = False
        if self._on_store_failure is not None:
            self._on_store_failure()

    def _note_success(self) -> None:
        if not self._store_reachable:
            _log.info("sessions are saved again", extra={"event": "store_restored"})
        self._store_reachable = True


@dataclass
class _Turn:
    """Lets the sockets that resume one session do so one after the other; `sockets` of them do so or wait."""

    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    sockets: int = 0

    def check_latest(self) -> None:
        """Raises EvictedError if a later socket waits for its turn."""
        if self.sockets > 1:
            raise _evicted()


def _evicted() -> EvictedError:
    return EvictedError("the session was resumed over another socket", "use a resume token on one socket at a time")


def _store_key(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
