"""Servers, networks and frames that several tests use."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import cv2
import fakes
import numpy as np
import pytest
from servers import serving

from lanestream.engine import Engine, load_engine
from lanestream.settings import Settings
from lanestream_exporter.scenes import Drive, render_clip, sample_clip

Serve = Callable[..., str]


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
