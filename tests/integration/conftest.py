"""Real servers on real sockets, in this process, each in its own thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import cv2
import fakes
import numpy as np
import pytest

from lanestream.api import create_app
from lanestream.api.server import LanestreamServer, listen
from lanestream.engine import Engine, load_engine
from lanestream.settings import Settings
from lanestream_client.overlays import draw_lanes
from lanestream_exporter.scenes import Drive, render_clip, sample_clip

Serve = Callable[..., str]


@contextmanager
def serving(engine: Engine | None, settings: Settings) -> Iterator[str]:
    """Runs a server around `engine` and yields its URL."""
    app = create_app(engine, settings, draw_lanes)
    listener = listen("127.0.0.1", 0)
    server = LanestreamServer(app, settings)
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
    """Returns a function that starts a server with an engine and settings, and returns its URL."""
    with ExitStack() as stack:
        yield lambda engine=None, **settings: stack.enter_context(serving(engine, Settings(**settings)))


@pytest.fixture(scope="session")
def url() -> Iterator[str]:
    """Returns the URL of a server with fake networks."""
    with serving(fakes.engine(), Settings(max_bytes=200_000)) as url:
        yield url


@pytest.fixture(scope="session")
def both_url() -> Iterator[str]:
    """Returns the URL of a server with both detectors and fake networks."""
    with serving(fakes.two_detectors(), Settings()) as url:
        yield url


@pytest.fixture(scope="session")
def real_engine() -> Engine:
    """Returns an engine with the shipped networks on the CPU."""
    return load_engine(None, "cpu")


@pytest.fixture(scope="session")
def real_url(real_engine: Engine) -> Iterator[str]:
    """Returns the URL of a server with the shipped networks."""
    with serving(real_engine, Settings()) as url:
        yield url


@pytest.fixture(scope="session")
def road() -> bytes:
    """Returns a frame of a rendered highway with clearly visible boundaries, as a JPEG."""
    clip = sample_clip(np.random.default_rng(24), 640, 360, frames=1, fps=25.0, drive=Drive("highway", fair=True))
    (frame,) = render_clip(clip)
    return cv2.imencode(".jpg", frame.image)[1].tobytes()
