"""The live page in a real Chromium, on its demo clip: `make page-speed` measures it, and `make page-picture` draws it.

Both start a service of their own.
"""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click
import cv2
import numpy as np
from demo import OUT, service
from playwright.sync_api import Page, sync_playwright

OPTIONS = ("--no-sandbox", "--disable-gpu", "--disable-quic", "--disable-background-networking", "--disable-sync")
# Stores the seconds at which frames are drawn, and the milliseconds since their capture.
WATCH = """() => {
    const canvas = document.querySelector("#panes canvas");
    window.drawnFrames = [];
    const note = () => window.drawnFrames.push([performance.now() / 1000, Number(canvas.dataset.latency)]);
    new MutationObserver(note).observe(canvas, { attributeFilter: ["data-seq"] });
}"""
WARM_UP_S = 5.0
DRAWN_S = 30.0
# Seconds into the clip for the picture.
PICTURE_AT_S = 6.0
MOST_PICTURE_BYTES = 300_000


@click.group()
def main() -> None:
    """Measure or draw the live page."""


@main.command()
@click.option("--detector", default="regression", show_default=True, type=click.Choice(["regression", "candidates"]))
@click.option("--seconds", default=20.0, show_default=True, type=click.FloatRange(1.0, 600.0))
def speed(detector: str, seconds: float) -> None:
    """Print how many frames per second the page draws, and how long after their capture."""
    with live_page(f"#detector={detector}") as page:
        page.keyboard.press("d")
        wait_until_drawn(page, 1)
        page.wait_for_timeout(1000.0 * WARM_UP_S)
        page.evaluate(WATCH)
        page.wait_for_timeout(1000.0 * seconds)
        frames = np.array(page.evaluate("window.drawnFrames"), dtype=float).reshape(-1, 2)
        sent = page.locator("#sent").inner_text()
        stages = page.locator("#waterfall tr").evaluate_all("rows => rows.map((row) => row.innerText.split(/\\s+/))")
        dropped = page.locator("#live").get_attribute("data-dropped")
    if len(frames) < 2:
        raise click.ClickException(f"the page drew {len(frames)} frames in {seconds:g} s")
    times, latencies = frames.T
    click.echo(f"detector {detector}, {len(frames)} frames in {times[-1] - times[0]:.1f} s; {dropped} dropped. {sent}")
    click.echo(f"drawn                       {(len(times) - 1) / (times[-1] - times[0]):6.1f} frames/s")
    for name, share in (("median", 50.0), ("p95", 95.0)):
        click.echo(f"capture to drawing, {name:6}  {np.percentile(latencies, share):6.1f} ms")
    for name, *value in stages:
        click.echo(f"  {name.lower():24}  {value[-1]:>6} ms")


@main.command()
@click.argument("out", type=click.Path(path_type=Path, dir_okay=False))
def picture(out: Path) -> None:
    """Write a picture of the page while it plays its demo clip to the JPEG file OUT."""
    with live_page("#detector=candidates") as page:
        page.keyboard.press("d")
        wait_until_drawn(page, 1)
        while float(page.locator("#panes canvas").get_attribute("data-timestamp") or 0.0) < PICTURE_AT_S:
            page.wait_for_timeout(20.0)
        png = page.screenshot()
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise click.ClickException("Chromium made no picture")
    jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 86, cv2.IMWRITE_JPEG_OPTIMIZE, 1])[1].tobytes()
    if len(jpeg) > MOST_PICTURE_BYTES:
        raise click.ClickException(f"the picture has {len(jpeg)} bytes, more than {MOST_PICTURE_BYTES}")
    out.write_bytes(jpeg)
    click.echo(f"{out}: {image.shape[1]} x {image.shape[0]}, {len(jpeg)} bytes")


@contextmanager
def live_page(settings: str) -> Iterator[Page]:
    """Yields the page of a service of its own, with `settings` in its hash."""
    OUT.mkdir(exist_ok=True)
    executable = shutil.which("chromium")
    with service(OUT / "live-page.log") as url, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=list(OPTIONS))
        page = browser.new_page(viewport={"width": 1440, "height": 960}, color_scheme="light")
        page.goto(f"{url}/{settings}")
        yield page
        browser.close()


def wait_until_drawn(page: Page, count: int) -> None:
    """Returns once the page has drawn this many answers. Exits if that takes too long."""
    end = time.monotonic() + DRAWN_S
    while int(page.locator("#live").get_attribute("data-drawn") or 0) < count:
        if time.monotonic() > end:
            sys.exit(f"error: the page drew nothing: {page.locator('#connection, #alerts').all_inner_texts()}")
        page.wait_for_timeout(50.0)


if __name__ == "__main__":
    main()
