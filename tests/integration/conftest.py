"""Real servers on real sockets, in this process, each in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import cv2
import fakes
import numpy as np
import pytest

from lanestream.api import create_app
from lanestream.api.server import Server, listen
from lanestream.engine import Engine, load_engine
from lanestream.settings import Settings
from lanestream_client.overlays import draw_lanes
from lanestream_exporter.scenes import Drive, render_clip, sample_clip

Serve = Callable[..., str]


@contextmanager
def serving(engine: Engine | None, settings: Settings) -> Iterator[str]:
    """The URL of a server around `engine`."""
    app = create_app(engine, settings, draw_lanes)
    listener = listen("127.0.0.1", 0)
    server = Server(app, settings)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    url = f"http://127.0.0.1:{listener.getsockname()[1]}"
    thread.start()
    try:
        yield url
    finally:
        server.should_exit = True
        thread.join(fakes.WAIT_S)
        assert not thread.is_alive()


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Starts a server with an engine and settings of the test's choice, and gives its URL."""
    with ExitStack() as stack:
        yield lambda engine=None, **settings: stack.enter_context(serving(engine, Settings(**settings)))


@pytest.fixture(scope="session")
def url() -> Iterator[str]:
    """A server with an engine of fakes that answer at once."""
    with serving(fakes.engine(), Settings(max_bytes=200_000)) as place:
        yield place


@pytest.fixture(scope="session")
def both_url() -> Iterator[str]:
    """A server with an engine of fakes that has both detectors."""
    with serving(fakes.two_detectors(), Settings()) as place:
        yield place


@pytest.fixture(scope="session")
def real_engine() -> Engine:
    """The shipped network on the CPU."""
    return load_engine(None, "cpu")


@pytest.fixture(scope="session")
def real_url(real_engine: Engine) -> Iterator[str]:
    """A server with the shipped network."""
    with serving(real_engine, Settings()) as place:
        yield place


@pytest.fixture(scope="session")
def road() -> bytes:
    """A frame of a rendered highway whose boundaries are surely seen, as a JPEG."""
    clip = sample_clip(np.random.default_rng(24), 640, 360, frames=1, fps=25.0, drive=Drive("highway", fair=True))
    (frame,) = render_clip(clip)
    return cv2.imencode(".jpg", frame.image)[1].tobytes()
