"""Where the JavaScript client runs: in a page and in Node. Both run the functions of scenarios.js."""

from __future__ import annotations

import json
import queue
import subprocess
import threading
from pathlib import Path
from typing import Any, Protocol

import fakes
import pytest
from playwright.sync_api import Page, Route

FOLDER = Path(__file__).parent / "browser"
LIBRARY = FOLDER.parents[1] / "client/js/dist"
if not (LIBRARY / "index.js").exists():
    pytest.fail("client/js is not built: run `make js`", pytrace=False)
# A scenario processes up to some hundred frames on a machine that may do other things, too.
RESULT_S = 60.0


def evaluate(page: Page, function: str, argument: Any = None) -> Any:
    """Returns what a function of JavaScript resolves to, and fails if that takes too long."""
    page.evaluate(
        """([source, argument]) => {
            window.outcome = undefined;
            const keep = (outcome) => (window.outcome = outcome);
            Promise.resolve(eval(source)(argument)).then((value) => keep({ value }), (error) => keep({ error }));
        }""",
        [f"({function})", argument],
    )
    page.wait_for_function("window.outcome", timeout=1000.0 * RESULT_S)
    return page.evaluate("'error' in outcome ? Promise.reject(outcome.error) : outcome.value")


class Scenario(Protocol):
    """A scenario that runs."""

    def wait_for(self, value: Any, count: int = 1) -> None:
        """Waits for `count` further reports of this value."""

    def stop(self) -> None:
        """Asks the scenario to stop sending frames."""

    def result(self) -> Any:
        """Returns what the scenario returns."""


class Runtime(Protocol):
    """Runs scenarios."""

    def start(self, name: str, url: Any, *, page_url: str | None = None, **arguments: Any) -> Scenario:
        """Starts a scenario with a service at `url`, or with replicas at several. A page may be of another service."""


class NodeScenario:
    """A process of Node."""

    def __init__(self, frames: Path, name: str, arguments: dict[str, Any]) -> None:
        command = ["node", "--experimental-websocket", "--no-warnings", str(FOLDER / "run_scenario.js")]
        command += [str(LIBRARY / "index.js"), str(frames), name, json.dumps(arguments)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._lines: queue.Queue[dict[str, Any]] = queue.Queue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def wait_for(self, value: Any, count: int = 1) -> None:
        while count:
            line = self._lines.get(timeout=fakes.WAIT_S)
            assert "report" in line, line
            count -= line["report"] == value

    def stop(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()

    def result(self) -> Any:
        while "result" not in (line := self._lines.get(timeout=RESULT_S)):
            assert "report" in line, line
        self.close()
        return line["result"]

    def close(self) -> None:
        """Ends the process, if it has not ended by itself."""
        try:
            assert self._process.wait(fakes.WAIT_S) == 0
        finally:
            self._process.kill()
            self._reader.join()
            for pipe in (self._process.stdin, self._process.stdout):
                assert pipe is not None
                pipe.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(json.loads(line))
        self._lines.put({"ended": "before its result"})


class Node:
    """Runs scenarios in Node, with the frames in a folder."""

    def __init__(self, frames: Path) -> None:
        self._frames = frames

    def start(self, name: str, url: Any, *, page_url: str | None = None, **arguments: Any) -> Scenario:
        return NodeScenario(self._frames, name, {"url": url, **arguments})


class PageScenario:
    """A promise in a page."""

    def __init__(self, page: Page, name: str, arguments: dict[str, Any]) -> None:
        self._page = page
        page.evaluate(
            """async ([name, args]) => {
                const [lib, scenarios, frames] = await Promise.all([
                    import("/test-page/client/index.js"),
                    import("/test-page/scenarios.js"),
                    fetch("/test-page/frames.json").then((response) => response.json()),
                ]);
                const binary = frames.map((frame) => Uint8Array.from(atob(frame), (each) => each.charCodeAt(0)));
                window.reports = [];
                const report = (value) => window.reports.push(JSON.stringify(value));
                const stopped = async () => window.stopped;
                window.result = scenarios[name]({ lib, frames: binary, report, stopped, ...args });
                window.result.catch(() => {});  // `result` reports it
            }""",
            [name, arguments],
        )
        self._seen = 0

    def wait_for(self, value: Any, count: int = 1) -> None:
        position = self._page.wait_for_function(
            """([value, count, seen]) => {
                for (let index = seen; index < window.reports.length; index++) {
                    count -= window.reports[index] === value;
                    if (count === 0) {
                        return index + 1;
                    }
                }
                return 0;
            }""",
            arg=[json.dumps(value, separators=(",", ":")), count, self._seen],
            timeout=1000.0 * fakes.WAIT_S,
            polling=5,
        )
        self._seen = position.json_value()

    def stop(self) -> None:
        self._page.evaluate("window.stopped = true")

    def result(self) -> Any:
        return evaluate(self._page, "() => window.result")


class Chromium:
    """Runs scenarios in a page of a service, so that the service sees its own origin.

    The page itself comes from the service: one that a test made up may not connect to this machine.
    """

    def __init__(self, page: Page, frames: str) -> None:
        self._page = page
        self._frames = frames

    def start(self, name: str, url: Any, *, page_url: str | None = None, **arguments: Any) -> Scenario:
        """Starts a scenario in a page of `page_url`, by default of the first replica."""
        self.open_page(page_url or (url if isinstance(url, str) else url[0]))
        return PageScenario(self._page, name, {"url": url, **arguments})

    def open_page(self, url: str) -> None:
        """Opens a document of the service at `url`, whose origin has the files of the tests, too."""
        self._page.route("**/favicon.ico", lambda route: route.fulfill(status=204))
        self._page.route("**/test-page/**", self._respond)
        self._page.goto(f"{url}/healthz")

    def _respond(self, route: Route) -> None:
        name = route.request.url.partition("/test-page/")[2]
        if name == "frames.json":
            route.fulfill(content_type="application/json", body=self._frames)
        elif name.startswith("client/"):
            route.fulfill(content_type="text/javascript", path=LIBRARY / name.removeprefix("client/"))
        else:
            route.fulfill(content_type="text/javascript", path=FOLDER / name)
