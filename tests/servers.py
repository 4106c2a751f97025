"""Real servers on real sockets, in this process, each in its own thread."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import fakes

from lanestream.api import create_app
from lanestream.api.server import LanestreamServer, listen
from lanestream.engine import Engine
from lanestream.settings import Settings
from lanestream_client.overlays import draw_lanes


@contextmanager
def serving(
    engine: Engine | None, settings: Settings, loop: Callable[[], asyncio.AbstractEventLoop] | None = None
) -> Iterator[str]:
    """Runs a server around `engine` and yields its URL. `loop` returns another event loop than the default one."""
    app = create_app(engine, settings, draw_lanes)
    server = LanestreamServer(app, settings)
    listener = listen("127.0.0.1", 0)
    if loop is not None:
        server.config.get_loop_factory = lambda: loop  # type: ignore[method-assign]
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    url = f"{'http' if settings.tls_certificate is None else 'https'}://127.0.0.1:{listener.getsockname()[1]}"
    thread.start()
    try:
        yield url
    finally:
        server.should_exit = True
        thread.join(fakes.WAIT_S)
        assert not thread.is_alive()
