"""An HTTP and a SOCKS 5 proxy that lead every connection to one port of this machine, whatever its host is called."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

_TIMEOUT_S = 10.0


@contextmanager
def proxy_server(serve: Callable[[socket.socket, list[str]], None]) -> Iterator[tuple[int, list[str]]]:
    """Runs a proxy whose connections `serve` handles. Yields its port, and the targets that clients asked for."""
    asked: list[str] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=_accept, args=(listener, serve, asked))
        thread.start()
        try:
            yield listener.getsockname()[1], asked
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join()


def http_proxy(port: int) -> Callable[[socket.socket, list[str]], None]:
    """Returns a handler that forwards requests and tunnels to `port`."""

    def serve(client: socket.socket, asked: list[str]) -> None:
        head = client.recv(1 << 16)
        asked.append(head.split()[1].decode())
        with socket.create_connection(("127.0.0.1", port)) as service:
            if head.startswith(b"CONNECT"):
                client.sendall(b"HTTP/1.1 200 OK\r\n\r\n")
            else:
                method, target, rest = head.split(b" ", 2)
                service.sendall(b" ".join((method, b"/" + target.split(b"/", 3)[3], rest)))
            _join(client, service)

    return serve


def socks_proxy(port: int) -> Callable[[socket.socket, list[str]], None]:
    """Returns a handler that connects to `port` by SOCKS 5 without authentication (RFC 1928)."""

    def serve(client: socket.socket, asked: list[str]) -> None:
        client.recv(256)
        client.sendall(b"\x05\x00")
        request = client.recv(256)
        asked.append(request[5 : 5 + request[4]].decode() if request[3] == 3 else "an address")
        with socket.create_connection(("127.0.0.1", port)) as service:
            client.sendall(b"\x05\x00\x00\x01\x00\x00\x00\x00\x00\x00")
            _join(client, service)

    return serve


def refusing_proxy(answer: bytes) -> Callable[[socket.socket, list[str]], None]:
    """Returns a handler that answers every request the same."""

    def serve(client: socket.socket, asked: list[str]) -> None:
        client.recv(1 << 16)
        client.sendall(answer)

    return serve


def _accept(listener: socket.socket, serve: Callable[[socket.socket, list[str]], None], asked: list[str]) -> None:
    with suppress(OSError):
        while True:
            client = listener.accept()[0]
            client.settimeout(_TIMEOUT_S)
            threading.Thread(target=_handle, args=(client, serve, asked)).start()


def _handle(client: socket.socket, serve: Callable[[socket.socket, list[str]], None], asked: list[str]) -> None:
    with client, suppress(OSError):
        serve(client, asked)


def _join(client: socket.socket, service: socket.socket) -> None:
    """Copies bytes both ways until one side closes."""
    back = threading.Thread(target=_copy, args=(service, client))
    back.start()
    _copy(client, service)
    back.join()


def _copy(source: socket.socket, sink: socket.socket) -> None:
    with suppress(OSError):
        while data := source.recv(1 << 16):
            sink.sendall(data)
    with suppress(OSError):
        sink.shutdown(socket.SHUT_WR)
