"""A TCP proxy that can break connections, and stop forwarding as a network does that drops all packets."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import fakes


class TcpProxy:
    """Forwards connections to a port of this machine until they are cut."""

    def __init__(self, listener: socket.socket, port: int) -> None:
        self._target = ("127.0.0.1", port)
        self._listener = listener
        self._sockets: list[socket.socket] = []
        self._forwards = threading.Event()
        self._forwards.set()
        self.port: int = listener.getsockname()[1]

    def run(self) -> None:
        """Accepts connections until the listener is closed."""
        with suppress(OSError):
            while True:
                ends = [self._listener.accept()[0]]
                with suppress(OSError):
                    ends.append(socket.create_connection(self._target))
                self._sockets += ends
                if len(ends) == 1:
                    ends[0].close()
                    continue
                for source, sink in (ends, ends[::-1]):
                    threading.Thread(target=self._forward, args=(source, sink)).start()

    def redirect(self, port: int) -> None:
        """Forwards new connections to another port of this machine. Open ones stay where they are."""
        self._target = ("127.0.0.1", port)

    def cut(self) -> None:
        """Breaks all open connections."""
        for end in self._sockets:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        self._sockets.clear()

    @contextmanager
    def black_hole(self) -> Iterator[None]:
        """Forwards nothing during the block. New connections are accepted, as the kernel does, and get no answer."""
        self._forwards.clear()
        try:
            yield
        finally:
            self._forwards.set()

    def _forward(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                self._forwards.wait()
                sink.sendall(data)
        with suppress(OSError):
            sink.shutdown(socket.SHUT_RDWR)


@contextmanager
def tcp_proxy(port: int, own_port: int = 0) -> Iterator[TcpProxy]:
    """Runs a proxy in front of a port of this machine, by default on a free port."""
    with socket.create_server(("127.0.0.1", own_port)) as listener:
        proxy = TcpProxy(listener, port)
        thread = threading.Thread(target=proxy.run)
        thread.start()
        try:
            yield proxy
        finally:
            proxy.cut()
            listener.shutdown(socket.SHUT_RDWR)
            thread.join(fakes.WAIT_S)
