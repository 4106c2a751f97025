"""A real Chromium, whose camera shows a rendered road, and a real service in another process."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import processes
import pytest
from playwright.sync_api import Browser, ConsoleMessage, Page, sync_playwright

from lanestream_exporter.scenes import Drive, render_clip, sample_clip

CAMERA_FPS = 25.0
CAMERA_FRAMES = 50


@pytest.fixture(scope="session")
def road_frames() -> list[bytes]:
    """Returns the frames of a rendered highway, as JPEGs."""
    clip = sample_clip(
        np.random.default_rng(24), 640, 360, frames=CAMERA_FRAMES, fps=CAMERA_FPS, drive=Drive("highway", fair=True)
    )
    return [cv2.imencode(".jpg", frame.image)[1].tobytes() for frame in render_clip(clip)]


@pytest.fixture(scope="session")
def camera_file(road_frames: list[bytes], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a file that Chromium's camera shows over and over."""
    path = tmp_path_factory.mktemp("camera") / "road.mjpeg"
    path.write_bytes(b"".join(road_frames))
    return path


# Playwright's event loop occupies the thread while it runs, so that it must not outlive the tests of a module.
@pytest.fixture(scope="module")
def browser(camera_file: Path) -> Iterator[Browser]:
    """Returns a Chromium that pages may use the camera of without asking."""
    executable = shutil.which("chromium")
    if executable is None:
        pytest.fail("chromium is not installed (on Debian: apt install chromium)")
    options = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
    options += ["--disable-component-update", "--disable-sync"]
    options += ["--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream"]
    options += [f"--use-file-for-fake-video-capture={camera_file}"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=options)
        yield browser
        browser.close()


@pytest.fixture
def console_errors() -> list[str]:
    """Returns the errors that the page has logged or not caught. A test that expects some clears the list."""
    return []


@pytest.fixture
def page(browser: Browser, console_errors: list[str]) -> Iterator[Page]:
    """Returns a new page. Fails if there are `console_errors` at the end of the test."""

    def log(message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            console_errors.append(message.text)

    page = browser.new_page()
    page.on("console", log)
    page.on("pageerror", lambda error: console_errors.append(str(error)))
    yield page
    page.context.close()
    assert console_errors == []


@pytest.fixture(scope="session")
def service() -> Iterator[str]:
    """Returns the URL of a service with the shipped networks, in another process. For other settings, see processes."""
    with processes.service() as (_, url):
        yield url
