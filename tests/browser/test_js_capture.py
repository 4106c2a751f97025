"""Frames that a page captures, and the examples for pages and for Node."""

from __future__ import annotations

import functools
import http.server
import json
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import fakes
import processes
import pytest
from jsruntimes import Chromium, evaluate
from playwright.sync_api import Page, expect

EXAMPLES = Path(__file__).parents[2] / "examples"
CLIENT = Path(__file__).parents[2] / "client/js"


@contextmanager
def folder_server(folder: Path) -> Iterator[str]:
    """Serves the files of a folder."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_request(self, code: object = "-", size: object = "-") -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(folder))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join(fakes.WAIT_S)


@pytest.fixture
def capture_page(page: Page, service: str) -> Page:
    Chromium(page, "[]").open_page(service)
    evaluate(page, "async () => void Object.assign(window, await import('/test-page/capture.js'))")
    return page


@pytest.mark.parametrize(
    ("source", "options", "size"),
    [
        ("video", {}, (640, 360)),
        ("stream", {"maxWidth": 400}, (400, 225)),
        ("track", {"quality": 0.5, "fps": 20}, (640, 360)),
        ("canvas", {}, (320, 180)),
    ],
)
def test_captured_frames_have_lanes(
    capture_page: Page, source: str, options: dict[str, float], size: tuple[int, int]
) -> None:
    result = evaluate(capture_page, "([name, options]) => capture(name, 12, options)", [source, options])
    answers = result["answers"]
    assert {(answer["width"], answer["height"]) for answer in answers} == {size}
    times = [answer["timestamp"] for answer in answers]
    assert times == sorted(set(times))
    assert max(answer["lanes"] for answer in answers) >= 2
    assert (result["errors"], result["more"]) == ([], 0)
    # What there was no time for was not sent.
    assert result["summary"]["dropped"] <= 2


def test_a_paused_video_sends_nothing(capture_page: Page) -> None:
    frames = evaluate(
        capture_page,
        """async () => {
            video.pause();
            setTimeout(() => video.play(), 500);
            const { answers } = await capture("video", 1);
            return answers.length;
        }""",
    )
    assert frames == 1


def test_the_example_for_pages(page: Page) -> None:
    with (
        folder_server(EXAMPLES / "browser") as page_url,
        processes.service(allowed_origins=page_url) as (_, url),
    ):
        page.route("**/favicon.ico", lambda route: route.fulfill(status=204))
        page.goto(f"{page_url}/?service={url}")
        expect(page.locator("#state")).to_have_text("open ")
        page.wait_for_function(
            """() => {
                const { width, height } = canvas;
                const copy = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
                copy.drawImage(canvas, 0, 0);
                const { data } = copy.getImageData(0, 0, width, height);
                let lime = 0;
                for (let index = 0; index < data.length; index += 4) {
                    lime += data[index] === 0 && data[index + 1] === 255 && data[index + 2] === 0;
                }
                return width === 640 && lime > 500;
            }"""
        )
        page.goto("about:blank")  # before the service ends, which the page would log


def test_the_example_for_node(service: str, road_frames: list[bytes], tmp_path: Path) -> None:
    shutil.copytree(EXAMPLES / "node", tmp_path / "example")
    modules = tmp_path / "example/node_modules"
    modules.mkdir()
    (modules / "lanestream").symlink_to(CLIENT)
    folder = tmp_path / "frames"
    folder.mkdir()
    for index, frame in enumerate(road_frames[:8]):
        (folder / f"{index}.jpg").write_bytes(frame)
    command = ["node", "--experimental-websocket", "--no-warnings", "folder.js", str(folder), service]
    run = subprocess.run(command, cwd=tmp_path / "example", capture_output=True, text=True, timeout=60, check=True)
    lines = run.stdout.splitlines()
    assert [line.split()[0] for line in lines[:8]] == [f"{index}.jpg" for index in range(8)]
    assert "marking" in lines[7]
    assert "answered: 8" in run.stdout
    dependencies = json.loads((EXAMPLES / "node/package.json").read_text())["dependencies"]
    assert dependencies == {"lanestream": "file:../../client/js"}
