"""TLS for installations without a proxy: the certificate, and connections that use it.

asyncio and uvicorn offer TLS, too, but hand a connection over only after its handshake, which may take a minute. Here a
connection counts from its first packet, and its peer has to keep to the limits of `ConnectionTable`, see there. OpenSSL
does the work, between two buffers in memory.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import math
import ssl
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from lanestream.api.connections import Connection, ConnectionTable
from lanestream.api.http_connection import HttpConnection
from lanestream.api.problems import raw_response
from lanestream.errors import ProtocolError, SettingsError, one_line

if TYPE_CHECKING:
    from collections.abc import Callable

_log = logging.getLogger(__name__)
_READ_BYTES: Final = 1 << 16
# What is decrypted at a time, and what may contain no data: a record is at most 16 KiB, but others can be tiny, such as
# those that change keys, and cost as much as large ones.
_PIECE_BYTES: Final = 1 << 12
_MOST_BYTES_WITHOUT_DATA: Final = 1 << 15
# The first byte of a TLS handshake (RFC 8446, section 5.1).
_HANDSHAKE_RECORD: Final = 22
# OpenSSL's X509_V_FLAG_NO_CHECK_TIME: an expired certificate is shown, too.
_NO_CHECK_TIME: Final = 0x200000


class Certificate:
    """The certificate of the service, with its chain and private key, and the TLS settings that go with it.

    `certificate` and `key` are PEM files; without `key` the first one contains the key, too. `expires_at` is in seconds
    since 1970, and NaN if it can't be found out. Raises SettingsError if the files can't be used.
    """

    def __init__(self, certificate: Path, key: Path | None) -> None:
        self._certificate, self._key = certificate, key
        self.context, self._digest = self._load()
        self.expires_at = _expiry(self.context, certificate)

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that it comes from."""
        return (self._certificate,) if self._key is None else (self._certificate, self._key)

    def reload(self) -> None:
        """Reads the files again, for new connections. If they can't be used, the certificate stays as it was."""
        try:
            context, digest = self._load()
        except SettingsError as error:
            _log.error("the certificate stays as it was: %s", error, extra={"event": "certificate_refused"})
            return
        if digest != self._digest:
            self.context, self._digest = context, digest
            self.expires_at = _expiry(context, self._certificate)
            _log.info("the certificate has changed", extra={"event": "certificate_changed"})

    def _load(self) -> tuple[ssl.SSLContext, bytes]:
        content = hashlib.sha256()
        for path in self.files:
            try:
                content.update(path.read_bytes())
            except OSError as error:
                reason = (error.strerror or str(error)).lower()
                raise SettingsError(f"can't read {path}: {reason}", "check --tls-certificate and --tls-key") from None
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        # A peer could ask for it again and again.
        context.options |= ssl.OP_NO_RENEGOTIATION
        context.set_alpn_protocols(["http/1.1"])
        try:
            # Without a function, OpenSSL would ask for the password of a key in the terminal.
            context.load_cert_chain(self._certificate, self._key, password=lambda: "")
        except (OSError, ssl.SSLError, ValueError) as error:
            files = " and ".join(map(str, self.files))
            raise SettingsError(
                f"can't use the certificate in {files}: {_reason(error)}",
                "use PEM files: the certificate with its chain, and its private key without a password",
            ) from None
        return context, content.digest()


class TlsConnection(Connection):
    """A connection that encrypts what is written to it; `context` has the certificate."""

    # It exists from `begin` on, before any other use of TLS.
    _tls: ssl.SSLObject

    def __init__(
        self,
        transport: asyncio.Transport,
        table: ConnectionTable,
        loop: asyncio.AbstractEventLoop,
        context: ssl.SSLContext,
    ) -> None:
        super().__init__(transport, table, loop)
        self._context = context
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._finished = False
        self._bytes_without_data = 0
        # What receives the decrypted data; None before the end of the handshake.
        self.protocol: asyncio.Protocol | None = None

    def begin(self) -> None:
        """Takes what a handshake needs, which a connection that only waits for its turn does without."""
        self._tls = self._context.wrap_bio(self._incoming, self._outgoing, server_side=True)

    def receive(self, data: bytes) -> None:
        """Takes encrypted data, for `shake_hands` and `read`."""
        self._incoming.write(data)
        self._bytes_without_data += len(data)

    def shake_hands(self) -> bool:
        """Continues the handshake. Returns whether it is complete. Raises ssl.SSLError if it fails."""
        try:
            self._tls.do_handshake()
        except ssl.SSLWantReadError:
            return False
        finally:
            super().write(self._outgoing.read())
        return True

    def read(self) -> bytes | None:
        """Returns decrypted data; None if there is none yet, and nothing (b"") once the peer has ended its side.

        Raises ssl.SSLError if what was received is not valid, or contains no data for too long.
        """
        try:
            data = self._tls.read(_READ_BYTES)
        except ssl.SSLWantReadError:
            if self._bytes_without_data > _MOST_BYTES_WITHOUT_DATA:
                raise ssl.SSLError(0, "records without data") from None
            return None
        except ssl.SSLZeroReturnError:
            return b""
        finally:
            # A peer may ask for new keys, which is answered.
            super().write(self._outgoing.read())
        self._bytes_without_data = 0
        return data

    def write(self, data: bytes | bytearray | memoryview[Any]) -> None:
        """Encrypts and sends data. Does nothing after the last answer."""
        if data and not self._finished:
            self._tls.write(data)
            super().write(self._outgoing.read())

    def write_plain(self, data: bytes) -> None:
        """Sends data without encryption, to a peer that does not use it."""
        super().write(data)

    def linger(self) -> None:
        """Ends the encrypted data, then closes the connection like any other."""
        self._finish()
        super().linger()

    def close(self) -> None:
        """Ends the encrypted data, then closes the connection like any other."""
        self._finish()
        super().close()

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """Returns what the system knows about the connection, or its `sslcontext`."""
        return self._context if name == "sslcontext" else super().get_extra_info(name, default)

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        """Makes another protocol receive the decrypted data."""
        assert isinstance(protocol, asyncio.Protocol)  # noqa: S101 - uvicorn's are
        self.protocol = protocol

    def _finish(self) -> None:
        if self.protocol is not None and not self._finished:
            self._finished = True
            # It sends the end, and then fails because the peer has not sent its own, which nobody waits for.
            with suppress(ssl.SSLError):
                self._tls.unwrap()
            super().write(self._outgoing.read())


class TlsProtocol(asyncio.Protocol):
    """Decrypts what one peer sends, and passes it on to an `HttpConnection` after the handshake.

    `table` has the limits.
    """

    # It exists from `connection_made` on, before any other event.
    _connection: TlsConnection

    def __init__(self, certificate: Certificate, table: ConnectionTable, **uvicorn: Any) -> None:
        self._certificate = certificate
        self._table = table
        self._make_http: Callable[[], HttpConnection] = lambda: HttpConnection(table, **uvicorn)
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._received = False
        self._has_turn = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Takes the connection, if there may be another one, and waits for the handshake."""
        self._connection = TlsConnection(transport, self._table, self._loop, self._certificate.context)
        self._table.admit(self._connection)
        if not self._connection.is_closing():
            self._timer = self._loop.call_later(self._table.limits.head_s, self._fail, "it took too long")

    def data_received(self, data: bytes) -> None:
        """Continues the handshake, or decrypts data."""
        if self._connection.discard(data):
            return
        if not self._received and data[0] != _HANDSHAKE_RECORD:
            self._refuse_plain()
            return
        for start in range(0, len(data), _PIECE_BYTES):
            self._connection.receive(data[start : start + _PIECE_BYTES])
            if self._connection.protocol is not None:
                self._read()
            elif self._has_turn:
                self._shake_hands()
        if not self._received:
            self._received = True
            self._connection.hold_reading(True)
            if self._table.begin_handshake(self._connection.address, self._begin_handshake):
                self._begin_handshake()

    def eof_received(self) -> None:
        """Passes on that the peer has ended its side. The connection is closed then."""
        if self._connection.protocol is not None:
            self._connection.protocol.eof_received()

    def connection_lost(self, exc: Exception | None) -> None:
        """Passes on that the peer is gone."""
        self._cancel_timer()
        if self._connection.protocol is None:
            self._connection.lost()
        else:
            self._connection.protocol.connection_lost(exc)

    def pause_writing(self) -> None:
        """Passes on that the peer does not read what it is sent."""
        if self._connection.protocol is not None:
            self._connection.protocol.pause_writing()

    def resume_writing(self) -> None:
        """Passes on that the peer reads again."""
        if self._connection.protocol is not None:
            self._connection.protocol.resume_writing()

    def _begin_handshake(self) -> None:
        if not self._connection.is_closing():
            self._has_turn = True
            self._connection.begin()
            self._connection.hold_reading(False)
            self._shake_hands()

    def _shake_hands(self) -> None:
        try:
            if not self._connection.shake_hands():
                return
        except ssl.SSLError as error:
            self._fail(_reason(error))
            return
        self._cancel_timer()
        http = self._make_http()
        self._connection.protocol = http
        http.connection_made(self._connection)
        self._read()

    def _read(self) -> None:
        """Passes on what can be decrypted. The protocol keeps what it gets while it has stopped reading."""
        while not self._connection.is_closing():
            try:
                data = self._connection.read()
            except ssl.SSLError as error:
                self._fail(_reason(error))
                return
            if data is None:
                return
            # WebSockets change it.
            protocol = self._connection.protocol
            assert protocol is not None  # noqa: S101 - after the handshake
            if not data:
                protocol.eof_received()
                self._connection.close()
                return
            protocol.data_received(data)

    def _refuse_plain(self) -> None:
        self._cancel_timer()
        self._connection.write_plain(
            raw_response(
                HTTPStatus.BAD_REQUEST,
                ProtocolError.code,
                "this port uses TLS, and the request came without it",
                "use https:// and wss://",
            )
        )
        self._connection.linger()

    def _fail(self, detail: str) -> None:
        self._cancel_timer()
        self._table.report("tls", self._connection.address, detail)
        # What OpenSSL has to say about it has been sent.
        self._connection.linger()

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def _expiry(context: ssl.SSLContext, certificate: Path) -> float:
    """Returns when the certificate of `context` expires, in seconds since 1970; NaN if it can't be found out.

    Python shows a certificate only to a peer that has verified it, so this plays one that trusts the file.
    """
    trusting = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    trusting.check_hostname = False
    trusting.verify_flags = ssl.VerifyFlags(trusting.verify_flags | ssl.VERIFY_X509_PARTIAL_CHAIN | _NO_CHECK_TIME)
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    try:
        trusting.load_verify_locations(certificate)
        client = trusting.wrap_bio(to_client, to_server)
        server = context.wrap_bio(to_server, to_client, server_side=True)
        # The client begins, and has the certificate with the server's answer.
        for side in (client, server, client):
            with suppress(ssl.SSLWantReadError):
                side.do_handshake()
        found = client.getpeercert() or {}
        return float(ssl.cert_time_to_seconds(str(found["notAfter"])))
    except (ssl.SSLError, OSError, ValueError, KeyError):
        return math.nan


def _reason(error: Exception) -> str:
    """Returns what OpenSSL says about an error."""
    reason = getattr(error, "reason", None) or getattr(error, "strerror", None) or str(error)
    return one_line(reason).replace("_", " ").lower()
