"""The live page in a browser, as its tests see and use it: through its elements and its data attributes."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Page, Request

# Far longer than anything takes, so that a test fails instead of hanging.
WAIT_S = 60.0
_POLL_MS = 50
_NOWHERE = "about:blank"


class LivePage:
    """Wraps a browser's page, and notes the addresses that it requests. Its last look is saved as `screenshot`."""

    def __init__(self, page: Page, screenshot: Path) -> None:
        self.page = page
        self._screenshot = screenshot
        self.requests: list[str] = []
        self._hosts: set[str] = set()
        page.on("request", self._note)

    def open(self, url: str, settings: str = "") -> None:
        """Opens the page of the service at `url` with `settings` in its hash, such as `#detector=regression`."""
        self._hosts.add(urlsplit(url).netloc)
        self.page.goto(f"{url}/{settings}")

    def leave(self) -> None:
        """Saves the screenshot and leaves the page, so that it does not notice that its service stops."""
        if self.page.url != _NOWHERE:
            self.page.screenshot(path=self._screenshot)
            self.page.goto(_NOWHERE)

    def attribute(self, name: str) -> str:
        """Returns an attribute of the page's state, `source`, `state`, `session`, `drawn` and others; "" if missing."""
        return self.page.locator("#live").get_attribute(f"data-{name}") or ""

    @property
    def drawn(self) -> int:
        """Returns how many answers were drawn."""
        return int(self.attribute("drawn") or 0)

    def shown(self, name: str, pane: int = 0) -> str:
        """Returns an attribute of the shown frame: `seq`, `frame`, `timestamp`, `ids`, `ego`, `detector` or `sent`."""
        return self.page.locator("#panes canvas").nth(pane).get_attribute(f"data-{name}") or ""

    def ids(self) -> set[str]:
        """Returns the track ids in the shown frame."""
        return set(self.shown("ids").split())

    def text(self, selector: str) -> str:
        """Returns the text of an element."""
        return self.page.locator(selector).inner_text()

    def wait(self, what: str, condition: Callable[[], object]) -> None:
        """Returns once `condition` holds, and fails with `what` if that takes too long."""
        end = time.monotonic() + WAIT_S
        while not condition():
            assert time.monotonic() < end, f"waited for {what}; the page says {self._state()}"
            self.page.wait_for_timeout(_POLL_MS)

    def wait_until_drawn(self, more: int = 3) -> None:
        """Returns once this many more answers were drawn."""
        enough = self.drawn + more
        self.wait(f"{more} drawn frames", lambda: self.drawn >= enough)

    def wait_for_ego_lane(self) -> None:
        """Returns once both boundaries of the ego lane are shown."""
        self.wait("both ego boundaries", lambda: len(self.shown("ego").split()) == 2)

    def pause(self) -> None:
        """Pauses, and returns once the last answers are drawn."""
        self.page.locator("#pause").click()
        self.wait_until_quiet()

    def wait_until_quiet(self) -> None:
        """Returns once no answers are drawn any more."""
        before = -1
        while self.drawn != before:
            before = self.drawn
            self.page.wait_for_timeout(500)

    def resume(self) -> None:
        """Goes on after a pause."""
        self.page.locator("#pause").click()

    def picture(self) -> NDArray[np.uint8]:
        """Returns what the first canvas shows, BGR (H, W, 3)."""
        png = self.page.locator("#panes canvas").first.screenshot()
        image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return np.asarray(image, np.uint8)

    def foreign_requests(self) -> list[str]:
        """Returns the addresses that were requested from other hosts than those that were opened."""
        addresses = [url for url in self.requests if urlsplit(url).scheme in ("http", "https", "ws", "wss")]
        return [url for url in addresses if urlsplit(url).netloc not in self._hosts]

    def _note(self, request: Request) -> None:
        self.requests.append(request.url)

    def _state(self) -> str:
        names = ("source", "state", "session", "drawn")
        problems = self.page.locator("#alerts p, #connection").all_inner_texts()
        return f"{ {name: self.attribute(name) for name in names} } {problems}"
