"""TCP connections: how many there may be, and what a peer must do to keep one.

A stranger can open connections without a key, so they are limited in total, by address, and without a session. At a
limit the oldest connection without a session gives way to the new one: an idle connection costs its peer nothing, and
whoever connects to do something must not be locked out by those who don't.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

from lanestream.api.turns import Turns
from lanestream.streaming.token_bucket import TokenBucket, TokenBuckets

if TYPE_CHECKING:
    from lanestream.api.byte_budget import ByteBudget

_log = logging.getLogger(__name__)

# The key of a connection in the state of an ASGI scope.
STATE_KEY: Final = "lanestream.connection"

CutReason = Literal[
    "address_limit", "limit", "full", "tls", "head", "body", "send", "pipeline", "message_size", "memory"
]
CUT_REASONS: Final[tuple[CutReason, ...]] = get_args(CutReason)
_MEANINGS: Final[dict[CutReason, str]] = {
    "address_limit": "its address has too many connections, and this was the oldest without a session",
    "limit": "there are too many connections, and this was the oldest without a session",
    "full": "there are too many connections, and every other one has a session",
    "tls": "TLS failed",
    "head": "the head of its request was too long, or took too long",
    "body": "the body of its request took too long",
    "send": "it did not read what it was sent",
    "pipeline": "it sent too many requests without waiting for answers",
    "message_size": "it sent a message that is too large",
    "memory": "the memory for unfinished messages is in use",
}

# A peer must take this much, or everything that waits for it, each time the limit of `send_s` passes.
_PROGRESS_BYTES: Final = 1 << 16
# How long, and how much, is still read from a peer after the last answer. A proxy that is reset while it sends a body
# may lose the answer, so of a body it is more than an image of the default `max_bytes`.
_LINGER_S: Final = 1.0
_MOST_DISCARDED_BYTES: Final = 1 << 22
_MOST_DISCARDED_BODY_BYTES: Final = 12 << 20
# An attack must not fill the log: one line for each reason in this time.
_LOG_EVERY_S: Final = 10.0
# Requests of one address, on average and as a burst. Most take less than a millisecond of the event loop.
_REQUESTS_PER_S: Final = 500.0
_REQUEST_BURST_S: Final = 1.0
# TLS handshakes of one address, on average and as a burst. With usual keys they take a millisecond of the event loop.
_HANDSHAKES_PER_S: Final = 500.0
_HANDSHAKE_BURST_S: Final = 1.0
# The rate of messages of all connections of a caller, as a multiple of that of one connection.
_CALLER_RATE: Final = 8.0
_MESSAGE_BURST_S: Final = 2.0
_NO_ADDRESS: Final = "local"


@dataclass(frozen=True)
class ConnectionLimits:
    """How many connections there may be and how long their peers may take, in seconds.

    `without_session` and `per_address` are parts of `connections`. A TLS handshake and the head of a request must be
    complete within `head_s` each, the body of a request within `body_s`; a peer must take a part of what it is sent
    within `send_s`, and an idle connection is closed after `keep_alive_s`. `messages_per_s` is the rate at which the
    pings, pongs and fragments of a WebSocket are read; a message counts as four of them.
    """

    connections: int
    without_session: int
    per_address: int
    head_s: float
    body_s: float
    send_s: float
    keep_alive_s: float
    messages_per_s: float


class ConnectionTable:
    """The open connections of a process.

    `is_proxy` returns whether an address is that of a trusted proxy, for which the limits per address do not hold.
    `observe` is called with the reason of every connection that is closed before its peer is done. `clock` returns
    monotonic seconds.
    """

    def __init__(
        self,
        limits: ConnectionLimits,
        budget: ByteBudget,
        is_proxy: Callable[[str], bool],
        observe: Callable[[CutReason], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.limits = limits
        self.budget = budget
        self._is_proxy = is_proxy
        self._observe = observe
        self._clock = clock
        self._requests = Turns(_REQUESTS_PER_S, _REQUEST_BURST_S, clock)
        self._handshakes = Turns(_HANDSHAKES_PER_S, _HANDSHAKE_BURST_S, clock)
        self._messages = TokenBuckets(_CALLER_RATE * limits.messages_per_s, _MESSAGE_BURST_S)
        # Connections without a session by address, each time the oldest first; a dict is an ordered set.
        self._evictable: defaultdict[str, dict[Connection, None]] = defaultdict(dict)
        self._with_session: set[Connection] = set()
        self._count: Counter[str] = Counter()
        self._next_log: dict[CutReason, float] = {}
        self._unlogged: Counter[CutReason] = Counter()

    def __len__(self) -> int:
        return self._count.total()

    def fit(self, most: int) -> None:
        """Lowers the limits to `most` connections, for example because the system allows few open files."""
        if most < self.limits.connections:
            _log.warning(
                "only %d of %d connections are possible: raise the limit of open files", most, self.limits.connections
            )
            fewer = self.limits.connections - most
            self.limits = replace(
                self.limits,
                connections=most,
                without_session=max(1, self.limits.without_session - fewer),
                per_address=min(self.limits.per_address, most),
            )

    def admit(self, connection: Connection) -> None:
        """Takes a new connection into the table, or closes it if every other one has a session."""
        address = connection.address
        if self._make_room(address):
            self._evictable[address][connection] = None
            self._count[address] += 1
        else:
            connection.cut("full")

    def begin_request(self, address: str, proceed: Callable[[], None]) -> bool:
        """Returns whether a request of an address may begin now. If not, `proceed` is called as soon as it may."""
        return self._is_proxy(address) or self._requests.begin(address, proceed)

    def begin_handshake(self, address: str, proceed: Callable[[], None]) -> bool:
        """Returns whether a TLS handshake of an address may begin now. See `begin_request`."""
        return self._is_proxy(address) or self._handshakes.begin(address, proceed)

    def count_request(self, address: str) -> None:
        """Counts a request that has begun without `begin_request`, behind the body of another one."""
        self._requests.count(address)

    def message_bucket(self) -> TokenBucket:
        """Returns the bucket of a new WebSocket, see `ConnectionLimits.messages_per_s`."""
        return TokenBucket(self.limits.messages_per_s, _MESSAGE_BURST_S, self._clock())

    def account_messages(self, account: str) -> TokenBucket:
        """Returns the bucket of all WebSockets of a caller or address."""
        return self._messages.bucket(account, self._clock())

    def protect(self, connection: Connection) -> None:
        """Keeps a connection from being closed in favor of another: it has a session now."""
        waiting = self._evictable.get(connection.address, {})
        if connection in waiting:
            self._remove_evictable(connection)
            self._with_session.add(connection)

    def unprotect(self, connection: Connection) -> None:
        """Ends the effect of `protect`."""
        if connection in self._with_session:
            self._with_session.remove(connection)
            self._evictable[connection.address][connection] = None

    def discard(self, connection: Connection) -> None:
        """Forgets a connection that is closed. May be called more than once."""
        if connection in self._with_session:
            self._with_session.remove(connection)
        elif connection in self._evictable.get(connection.address, {}):
            self._remove_evictable(connection)
        else:
            return
        self._count[connection.address] -= 1
        if not self._count[connection.address]:
            del self._count[connection.address]

    def abort_all(self) -> None:
        """Closes all connections at once; the service stops."""
        for connection in [*self._with_session, *(each for group in self._evictable.values() for each in group)]:
            connection.abort()

    def report(self, reason: CutReason, address: str, detail: str = "") -> None:
        """Counts and logs that a connection was cut."""
        now = self._clock()
        self._observe(reason)
        if now < self._next_log.get(reason, 0.0):
            self._unlogged[reason] += 1
            return
        self._next_log[reason] = now + _LOG_EVERY_S
        more = self._unlogged.pop(reason, 0)
        _log.warning(
            "closed a connection from %s: %s%s%s",
            address,
            _MEANINGS[reason],
            detail and f": {detail}",
            f" ({more} more before)" if more else "",
        )

    def _make_room(self, address: str) -> bool:
        """Closes a connection if there are too many for another one. Returns False if none may be closed."""
        limits = self.limits
        if self._count[address] >= limits.per_address and not self._is_proxy(address):
            return self._evict(address, "address_limit")
        without_session = len(self) - len(self._with_session)
        if len(self) >= limits.connections or without_session >= limits.without_session:
            busiest = max(self._evictable, key=lambda each: len(self._evictable[each]), default=address)
            return self._evict(busiest, "limit")
        return True

    def _evict(self, address: str, reason: CutReason) -> bool:
        oldest = next(iter(self._evictable.get(address, {})), None)
        if oldest is None:
            return False
        oldest.cut(reason)
        return True

    def _remove_evictable(self, connection: Connection) -> None:
        waiting = self._evictable[connection.address]
        del waiting[connection]
        if not waiting:
            del self._evictable[connection.address]


def _network(address: str) -> str:
    """Returns what counts as one address: with IPv6 the first 64 bits, which is what a single customer gets."""
    try:
        ip = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    return str(ipaddress.ip_network((ip, 64), strict=False)) if ip.version == 6 and not ip.ipv4_mapped else address


def connection_of(scope: Mapping[str, Any]) -> Connection | None:
    """Returns the connection of an ASGI scope; None under a server other than ours."""
    connection: Connection | None = scope.get("state", {}).get(STATE_KEY)
    return connection


class Connection(asyncio.Transport):
    """The transport of one connection. Its peer must take what it is sent, also after `close`.

    What the peer makes the service do is charged to its `account`: its address, and once it is known the caller.
    """

    def __init__(self, transport: asyncio.Transport, table: ConnectionTable, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        peer = transport.get_extra_info("peername")
        self.address = _network(str(peer[0])) if isinstance(peer, tuple) else _NO_ADDRESS
        self.account = self.address
        self.table = table
        self._transport = transport
        self._loop = loop
        self._written = 0
        self._due = 0
        self._progress_timer: asyncio.TimerHandle | None = None
        self._paused = self._held = self._reading_stopped = False
        self._lingering = self._ended = False
        # Whether the peer is still sending the body of a request, which may have been answered already.
        self.in_body = False
        self._discarded = 0

    def identify(self, caller: str) -> None:
        """Charges everything from now on to the account of `caller`."""
        self.account = caller

    def protect(self) -> None:
        """See ConnectionTable."""
        self.table.protect(self)

    def unprotect(self) -> None:
        """See ConnectionTable."""
        self.table.unprotect(self)

    def cut(self, reason: CutReason) -> None:
        """Closes the connection at once, without sending what still waits, and reports why."""
        self.table.report(reason, self.address)
        self.table.discard(self)
        self.abort()

    def lost(self) -> None:
        """Forgets the connection; its protocol calls this when it is closed."""
        self._ended = True
        self.table.discard(self)
        if self._progress_timer is not None:
            self._progress_timer.cancel()
            self._progress_timer = None

    def hold_reading(self, hold: bool) -> None:
        """Stops or continues reading, independently of `pause_reading` and `resume_reading`."""
        self._held = hold
        self._update_reading()

    def linger(self) -> None:
        """Closes the connection after a last answer, for a peer that may still be sending.

        Closing at once would reset the connection, and the peer would lose the answer. So what it sends is read and
        discarded for a moment.
        """
        if not self._lingering and not self._transport.is_closing():
            self._lingering = True
            self._paused = self._held = False
            self._update_reading()
            self._transport.write_eof()
            self._loop.call_later(_LINGER_S, self._close)

    def discard(self, data: bytes) -> bool:
        """Discards what a peer still sends while the connection lingers. Returns False if it does not."""
        if self._lingering:
            self._discarded += len(data)
            if self._discarded > (_MOST_DISCARDED_BODY_BYTES if self.in_body else _MOST_DISCARDED_BYTES):
                self.abort()
        return self._lingering

    def pause_reading(self) -> None:
        """Stops reading."""
        self._paused = True
        self._update_reading()

    def resume_reading(self) -> None:
        """Continues reading, unless it is held."""
        self._paused = False
        self._update_reading()

    def write(self, data: bytes | bytearray | memoryview[Any]) -> None:
        """Sends data when the peer takes it. Does nothing after the last answer."""
        if self._ended or self._lingering:
            return
        self._transport.write(data)
        self._written += len(data)
        if self._progress_timer is None and self._transport.get_write_buffer_size():
            self._expect_progress()

    def close(self) -> None:
        """Closes the connection once the peer has taken everything that was sent."""
        if self.in_body:
            self.linger()
        elif not self._lingering:
            self._close()

    def _close(self) -> None:
        self._transport.close()
        if self._progress_timer is None:
            self._expect_progress()

    def abort(self) -> None:
        """Closes the connection at once."""
        self._ended = True
        self._transport.abort()

    def is_closing(self) -> bool:
        """Returns whether the connection is closed or about to be."""
        return self._lingering or self._transport.is_closing()

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """Returns what the system knows about the connection."""
        return self._transport.get_extra_info(name, default)

    def get_write_buffer_size(self) -> int:
        """Returns the number of bytes that the peer has not taken yet."""
        return self._transport.get_write_buffer_size()

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        """Makes another protocol receive the events of the connection."""
        self._transport.set_protocol(protocol)

    def _update_reading(self) -> None:
        stop = self._paused or self._held
        if stop == self._reading_stopped or self._transport.is_closing():
            return
        self._reading_stopped = stop
        if stop:
            self._transport.pause_reading()
        else:
            self._transport.resume_reading()

    def _expect_progress(self) -> None:
        unsent = self._transport.get_write_buffer_size()
        self._due = self._written - unsent + min(unsent, _PROGRESS_BYTES)
        self._progress_timer = self._loop.call_later(self.table.limits.send_s, self._check_progress)

    def _check_progress(self) -> None:
        self._progress_timer = None
        unsent = self._transport.get_write_buffer_size()
        if unsent and self._written - unsent < self._due:
            self.cut("send")
        elif unsent:
            self._expect_progress()
