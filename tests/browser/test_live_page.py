"""The live page, used as a visitor does: in a real Chromium, with a real service."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import processes
import pytest
import trustme
from av.video.stream import VideoStream
from livepage import WAIT_S, LivePage
from numpy.typing import NDArray
from playwright.sync_api import Browser, Page, expect
from redisserver import redis_server

from lanestream.keys import new_key
from lanestream.protocol import LanesMessage

FPS = 25
SCREENSHOTS = Path(__file__).parents[2] / "out/screenshots"
# The palette of Okabe and Ito, in BGR.
ORANGE, SKY_BLUE = (0, 159, 230), (233, 180, 86)
BITS, BIT_SIZE = 9, 20
REGRESSION = "#detector=regression"


@pytest.fixture
def live(page: Page, request: pytest.FixtureRequest) -> Iterator[LivePage]:
    """Returns the page in a new tab. Fails if it requested anything from another host."""
    name = re.sub(r"\W+", "-", request.node.name).strip("-")
    live = LivePage(page, SCREENSHOTS / f"{name}.png")
    yield live
    live.leave()
    assert live.foreign_requests() == []


@pytest.fixture
def playing(live: LivePage, service: str) -> LivePage:
    """Returns the page while it plays its demo clip."""
    live.open(service, REGRESSION)
    live.page.keyboard.press("d")
    live.wait_until_drawn()
    return live


def write_video(path: Path, frames: list[NDArray[np.uint8]], fps: int = FPS) -> Path:
    """Writes BGR images as a VP9 video and returns its path."""
    with av.open(str(path), "w", format="webm") as container:
        options = {"deadline": "realtime", "cpu-used": "8", "crf": "20", "b": "0"}
        stream = container.add_stream("libvpx-vp9", rate=fps, options=options)
        assert isinstance(stream, VideoStream)
        (stream.height, stream.width), stream.pix_fmt = frames[0].shape[:2], "yuv420p"
        for number, frame in enumerate(frames):
            video_frame = av.VideoFrame.from_ndarray(frame, format="bgr24")
            video_frame.pts, video_frame.time_base = number, Fraction(1, fps)
            container.mux(stream.encode(video_frame))
        container.mux(stream.encode(None))
    return path


def road_images(files: list[bytes], count: int) -> list[NDArray[np.uint8]]:
    """Returns `count` images of a road, over and over."""
    images = [cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR) for file in files]
    assert all(image is not None for image in images)
    return [np.asarray(images[number % len(images)], np.uint8).copy() for number in range(count)]


def numbered(image: NDArray[np.uint8], number: int) -> NDArray[np.uint8]:
    """Returns an image with its number as black and white squares at the top."""
    for bit in range(BITS):
        image[:BIT_SIZE, bit * BIT_SIZE : (bit + 1) * BIT_SIZE] = 255 if number >> bit & 1 else 0
    return image


def number_of(picture: NDArray[np.uint8], width: int) -> int:
    """Returns the number in a picture of a numbered image that was `width` wide."""
    scale = picture.shape[1] / width
    row = round(scale * BIT_SIZE / 2)
    columns = [round(scale * (bit + 0.5) * BIT_SIZE) for bit in range(BITS)]
    return sum(1 << bit for bit, column in enumerate(columns) if picture[row, column].mean() > 127.0)


def pixels_of(picture: NDArray[np.uint8], color: tuple[int, int, int]) -> int:
    """Returns how many pixels have about this BGR color."""
    return int((np.abs(picture.astype(int) - color).max(axis=2) < 12).sum())


def test_the_demo_starts_by_one_key_and_its_lanes_are_drawn(live: LivePage, service: str) -> None:
    live.open(service, REGRESSION)
    live.page.keyboard.press("d")
    live.wait_until_drawn()
    live.wait_for_ego_lane()
    live.pause()
    picture = live.picture()
    assert pixels_of(picture, ORANGE) > 100
    assert pixels_of(picture, SKY_BLUE) > 100
    assert live.attribute("source") == "demo"
    assert live.text("#connection") == "Connected"
    assert live.text("#reading-width").endswith(" m")  # its camera is known


def test_the_demo_starts_from_the_keyboard_alone(live: LivePage, service: str) -> None:
    live.open(service, REGRESSION)
    for _ in range(12):
        live.page.keyboard.press("Tab")
        if live.page.locator("#start-demo:focus").count():
            break
    live.page.keyboard.press("Enter")
    live.wait_until_drawn()


def test_lanes_are_drawn_on_their_own_frame(
    live: LivePage, service: str, road_frames: list[bytes], tmp_path: Path
) -> None:
    images = road_images(road_frames, 2**BITS)
    video = write_video(tmp_path / "numbered.webm", [numbered(image, number) for number, image in enumerate(images)])
    live.open(service, REGRESSION)
    live.page.locator("#file").set_input_files(video)
    for _ in range(4):
        live.wait_until_drawn(5)
        live.pause()
        # The service sends the timestamp of the frame that it has answered. The picture shows which one it is.
        number = round(FPS * float(live.shown("timestamp"))) % len(images)
        assert number_of(live.picture(), images[0].shape[1]) == number
        assert live.shown("seq") == live.shown("frame")
        live.resume()


def test_a_4k_video_is_scaled_down(live: LivePage, service: str, road_frames: list[bytes], tmp_path: Path) -> None:
    images = [cv2.resize(image, (3840, 2160)) for image in road_images(road_frames, 10)]
    video = write_video(tmp_path / "4k.webm", [np.asarray(image, np.uint8) for image in images], fps=5)
    live.open(service, REGRESSION)
    live.page.locator("#file").set_input_files(video)
    live.wait_until_drawn(2)
    width, height = map(int, live.shown("sent").split("x"))
    assert width <= 1280
    assert abs(width / height - 16.0 / 9.0) < 0.01


def test_frames_get_smaller_than_the_limit(live: LivePage) -> None:
    with processes.service(max_pixels=300_000) as (_, url):
        live.open(url, REGRESSION)
        live.page.keyboard.press("d")
        live.wait_until_drawn()
        width, height = map(int, live.shown("sent").split("x"))
        assert width * height <= 300_000
        assert "pixels" not in live.text("#log")
        live.leave()


def test_a_dropped_video_plays(live: LivePage, service: str) -> None:
    live.open(service, REGRESSION)
    live.page.evaluate(
        """async () => {
            const clip = await (await fetch("static/demo.webm")).blob();
            const dataTransfer = new DataTransfer();
            dataTransfer.items.add(new File([clip], "drive.webm", { type: "video/webm" }));
            document.querySelector("#stage").dispatchEvent(new DragEvent("drop", { dataTransfer, bubbles: true }));
        }"""
    )
    live.wait_until_drawn()
    assert live.attribute("source") == "file"


def test_a_camera_streams(live: LivePage, service: str) -> None:
    live.open(service, REGRESSION)
    live.page.keyboard.press("c")
    live.wait_until_drawn(5)
    assert live.attribute("source") == "camera"
    live.wait_for_ego_lane()


def test_a_screen_streams_until_it_is_not_shared_any_more(live: LivePage, service: str) -> None:
    # A headless Chromium has no screen: its camera stands in for one.
    live.page.add_init_script(
        """if (navigator.mediaDevices) navigator.mediaDevices.getDisplayMedia = async () => {
            window.shared = await navigator.mediaDevices.getUserMedia({ video: true });
            return window.shared;
        }"""
    )
    live.open(service, REGRESSION)
    live.page.locator(".toolbar [data-source=screen]").click()
    live.wait_until_drawn()
    assert live.attribute("source") == "screen"
    live.page.evaluate("window.shared.getTracks()[0].dispatchEvent(new Event('ended'))")
    live.wait("the end", lambda: live.attribute("state") == "idle")
    expect(live.page.locator("#welcome")).to_be_visible()


def test_sources_go_on_in_a_hidden_page(live: LivePage, service: str) -> None:
    # Animation frames and timers of the page stand still, as in a tab in the background.
    live.page.add_init_script(
        "requestAnimationFrame = () => 0; HTMLVideoElement.prototype.requestVideoFrameCallback = () => 0;"
    )
    live.open(service, REGRESSION)
    live.page.keyboard.press("c")
    live.wait_until_drawn(5)
    live.page.keyboard.press("d")
    live.wait_until_drawn(5)
    expect(live.page.locator("#snapshot")).to_be_enabled()


def test_a_file_that_is_not_a_video_is_explained(
    live: LivePage, service: str, console_errors: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "notes.mp4"
    path.write_text("not a video")
    live.open(service)
    live.page.locator("#file").set_input_files(path)
    expect(live.page.locator("#alerts")).to_contain_text("This browser can't play notes.mp4. Convert it")
    assert live.attribute("state") == "idle"
    console_errors.clear()  # Chromium reports the file, too


def test_a_refused_camera_is_explained(live: LivePage, service: str) -> None:
    live.page.add_init_script(
        """if (navigator.mediaDevices) navigator.mediaDevices.getUserMedia = async () => {
            throw new DOMException("no", "NotAllowedError");
        }"""
    )
    live.open(service)
    live.page.keyboard.press("c")
    expect(live.page.locator("#alerts")).to_contain_text("The browser may not use the camera. Allow it")


def test_on_an_insecure_origin_the_demo_plays_and_the_camera_is_explained(live: LivePage) -> None:
    address = own_address()
    with processes.service(host=address) as (_, url):
        live.open(url, REGRESSION)
        live.page.keyboard.press("d")
        live.wait_until_drawn()
        live.page.keyboard.press("c")
        expect(live.page.locator("#alerts")).to_contain_text("https:// and localhost only. Open the page under one of")
        live.leave()


def test_with_a_certificate_the_camera_streams_from_another_machine(browser: Browser, tmp_path: Path) -> None:
    address, certificate = own_address(), tmp_path / "certificate.pem"
    trustme.CA().issue_cert(address).private_key_and_cert_chain_pem.write_to_path(str(certificate))
    with processes.service(host=address, tls_certificate=certificate) as (_, url):
        # The browser does not know the authority of the certificate.
        page = browser.new_page(ignore_https_errors=True)
        live = LivePage(page, tmp_path / "page.png")
        live.open(url, REGRESSION)
        page.keyboard.press("c")
        live.wait_until_drawn(5)
        assert live.attribute("source") == "camera"
        page.context.close()


def own_address() -> str:
    """Returns an address of this machine that browsers do not trust."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing
        except OSError:
            pytest.skip("this machine has no address but its own loopback")
        return str(probe.getsockname()[0])


def test_after_a_broken_connection_the_ids_are_the_same(playing: LivePage) -> None:
    # New tracks don't survive a gap.
    playing.wait_until_drawn(15)
    playing.wait_for_ego_lane()
    before = set(playing.shown("ego").split())
    playing.page.keyboard.press("b")
    playing.wait("the session", lambda: playing.attribute("session") == "resumed")
    playing.wait_until_drawn()
    assert before <= playing.ids()
    assert playing.text("#connection") == "Connected, same session"
    expect(playing.page.locator("#log")).to_contain_text("kept their ids")


@pytest.mark.parametrize("with_redis", [False, True], ids=["in memory", "Redis"])
def test_the_page_goes_on_after_a_restart(
    live: LivePage, console_errors: list[str], tmp_path: Path, with_redis: bool
) -> None:
    with redis_server(tmp_path) as redis_url:
        settings = {"redis_url": redis_url} if with_redis else {}
        with processes.service(**settings) as (process, url):
            live.open(url, REGRESSION)
            live.page.keyboard.press("d")
            live.wait_until_drawn(15)
            live.wait_for_ego_lane()
            before = live.shown("ego").split()
            process.send_signal(signal.SIGTERM)
            process.wait()
        live.wait("the outage", lambda: live.attribute("state") == "reconnecting")
        with processes.service(port=int(url.rpartition(":")[2]), **settings):
            live.wait("the session", lambda: live.attribute("session") == ("resumed" if with_redis else "new"))
            live.wait_until_drawn()
            if with_redis:
                assert set(before) <= live.ids()
                assert live.text("#connection") == "Connected, same session"
            else:
                assert live.text("#connection") == "Connected, new session"
                expect(live.page.locator("#log")).to_contain_text("in a new session: ids start again")
            live.leave()
    console_errors.clear()  # Chromium reports each attempt to connect


def test_a_key_is_asked_for_and_kept_nowhere(live: LivePage, console_errors: list[str]) -> None:
    key, stored = new_key("page")
    with processes.service(api_keys=stored) as (_, url):
        live.open(url, REGRESSION)
        live.page.keyboard.press("d")
        expect(live.page.locator("#access")).to_be_visible()
        live.page.keyboard.type("a-wrong-key")
        live.page.keyboard.press("Enter")
        expect(live.page.locator("#access-error")).to_have_text(
            "The service does not know this key. Check it, or ask whoever runs the service for one."
        )
        live.page.keyboard.type(key)
        live.page.keyboard.press("Enter")
        live.wait_until_drawn()
        token = json.loads(live.page.evaluate("fetch('readyz').then(() => JSON.stringify(performance.getEntries()))"))
        kept = live.page.evaluate(
            "JSON.stringify([location.href, {...localStorage}, {...sessionStorage}, document.cookie])"
        )
        for language in ("curl", "python", "javascript"):
            live.page.locator(f"#tab-{language}").click()
            assert "LANESTREAM_API_KEY" in live.text("#snippet") or "token" in live.text("#snippet")
            kept += live.text("#snippet")
        kept += live.page.content() + json.dumps(token) + "".join(live.requests)
        assert live.page.locator("#key").input_value() == ""
        live.leave()
        assert key not in kept
        assert "eyJ" not in kept  # how tokens begin
    console_errors.clear()  # Chromium reports the refusals


def test_a_forbidden_address_is_explained(live: LivePage, service: str, console_errors: list[str]) -> None:
    # Chromium resolves all names below localhost to this machine; the service accepts none of them.
    live.open(service.replace("127.0.0.1", "lanes.localhost"), REGRESSION)
    live.page.keyboard.press("d")
    expect(live.page.locator("#alerts")).to_contain_text("The service does not accept this page's address. Add it to")
    live.leave()
    console_errors.clear()


def test_a_busy_service_is_explained(live: LivePage, console_errors: list[str]) -> None:
    with processes.service(max_sessions=1) as (_, url):
        live.open(url, "#detector=both")
        live.page.keyboard.press("d")
        live.wait("the reason", lambda: "sessions are in use" in live.text("#connection"))
        live.leave()
    console_errors.clear()


def test_settings_are_kept_in_the_address(live: LivePage, service: str) -> None:
    live.open(service)
    page = live.page
    page.locator("[name=detector][value=regression]").check()
    page.get_by_label("Road edges").uncheck()
    page.locator("[name=horizon]").fill("0.43")
    page.locator("[name=height]").fill("1.75")
    page.locator("[name=fov]").fill("71")
    expected = "#detector=regression&kinds=marking&horizon=0.43&height=1.75&fov=71"
    live.wait("the settings", lambda: page.url.endswith(expected))
    page.locator("#tab-curl").click()
    query = "detector=regression&horizon=0.43&camera_height=1.75&field_of_view=71&kinds=marking"
    assert live.text("#snippet").endswith(f"{service}/v1/detect?{query}'")

    page.goto("about:blank")
    page.goto(service + "/" + expected)
    expect(page.locator("[name=detector][value=regression]")).to_be_checked()
    expect(page.get_by_label("Road edges")).not_to_be_checked()
    expect(page.get_by_label("Estimate it")).not_to_be_checked()
    assert [page.locator(f"[name={name}]").input_value() for name in ("horizon", "height", "fov")] == [
        "0.43",
        "1.75",
        "71",
    ]
    live.page.keyboard.press("d")
    live.wait_until_drawn()
    assert live.shown("detector") == "regression"


def test_the_python_program_runs(live: LivePage, service: str, road_frames: list[bytes], tmp_path: Path) -> None:
    write_video(tmp_path / "drive.webm", road_images(road_frames, 5)).rename(tmp_path / "drive.mp4")
    live.open(service, "#detector=regression&kinds=marking&horizon=0.45&height=1.4&fov=60")
    live.page.locator("#tab-python").click()
    command = [sys.executable, "-c", live.text("#snippet")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=WAIT_S)
    assert done.stderr == ""
    assert len(re.findall(r"lane_width_m=\d", done.stdout)) == 5
    assert all(line.startswith(f"{seq} ") for seq, line in enumerate(done.stdout.splitlines()))


def test_the_javascript_program_runs(live: LivePage, service: str, road_frames: list[bytes]) -> None:
    live.open(service, "#detector=regression&kinds=marking&horizon=0.45&height=1.4&fov=60")
    live.page.locator("#tab-javascript").click()
    # Static imports work only in modules.
    program = re.sub("import (.*) from (.*);", r"const \1 = await import(\2);", live.text("#snippet"))
    ego = live.page.evaluate(
        f"""(bytes) => new Promise((resolve, reject) => {{
            const jpeg = new Blob([new Uint8Array(bytes)], {{ type: "image/jpeg" }});
            const console = {{ log: (seq, ego) => resolve(ego) }};
            (async () => {{ {program}
            }})().catch(reject);
        }})""",
        list(road_frames[0]),
    )
    assert ego["lane_width_m"] > 2.0


def test_a_changed_setting_keeps_the_session(playing: LivePage) -> None:
    playing.wait_until_drawn(15)
    playing.wait_for_ego_lane()
    before = set(playing.shown("ego").split())
    playing.page.locator("[name=height]").fill("2")
    playing.wait("the setting", lambda: "height=2" in playing.page.url)
    playing.wait("the stream", lambda: playing.attribute("state") == "open")
    playing.wait_until_drawn(5)
    assert before <= playing.ids()
    playing.page.get_by_label("I know the camera").uncheck()
    playing.wait("no meters", lambda: " m" not in playing.text("#reading-width"))
    expect(playing.page.locator("#map-hint")).to_be_visible()


def test_both_detectors_run_side_by_side(live: LivePage, service: str) -> None:
    live.open(service, "#detector=both")
    live.page.keyboard.press("d")
    live.wait_until_drawn()
    live.wait("both", lambda: [live.shown("detector", pane) for pane in (0, 1)] == ["candidates", "regression"])
    live.page.locator("[name=detector][value=regression]").check()
    live.wait_until_drawn()
    assert live.page.locator("#panes canvas").count() == 1


def test_a_recording_and_a_snapshot_are_saved(playing: LivePage, tmp_path: Path) -> None:
    page = playing.page
    with page.expect_download() as snapshot:
        page.keyboard.press("s")
    snapshot.value.save_as(tmp_path / "snapshot.png")
    image = cv2.imread(str(tmp_path / "snapshot.png"))
    assert image is not None
    assert image.shape == (540, 960, 3)

    page.keyboard.press("r")
    playing.wait_until_drawn(10)
    page.keyboard.press("r")
    expect(page.locator("#downloads a")).to_have_count(2)
    for number, name in enumerate(("recording.webm", "recording.jsonl")):
        with page.expect_download() as download:
            page.locator("#downloads a").nth(number).click()
        download.value.save_as(tmp_path / name)
    with av.open(str(tmp_path / "recording.webm")) as container:
        frames = [(frame.width, frame.height) for frame in container.decode(video=0)]
    assert len(frames) > 3
    assert set(frames) == {(960, 540)}
    lines = (tmp_path / "recording.jsonl").read_text().splitlines()
    numbers = [LanesMessage.model_validate_json(line).seq for line in lines]
    assert len(numbers) >= 10
    assert numbers == sorted(set(numbers))


def test_a_phone_has_no_horizontal_scroll(live: LivePage, service: str) -> None:
    live.page.set_viewport_size({"width": 360, "height": 740})
    live.open(service, "#detector=both")
    assert live.page.evaluate("document.documentElement.scrollWidth") <= 360
    live.page.locator("#start-demo").click()
    live.wait_until_drawn()
    assert live.page.evaluate("document.documentElement.scrollWidth") <= 360


def test_dark_colors_are_remembered(live: LivePage, service: str) -> None:
    def brightness() -> float:
        colors = live.page.evaluate("getComputedStyle(document.body).backgroundColor")
        return float(np.mean([float(part) for part in colors[4:-1].split(",")]))

    live.page.emulate_media(color_scheme="light")
    live.open(service)
    assert brightness() > 200.0
    live.page.keyboard.press("t")
    assert brightness() < 60.0
    live.page.reload()
    assert brightness() < 60.0
