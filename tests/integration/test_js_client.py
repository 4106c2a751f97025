"""The package of the JavaScript client: its own tests, and what was generated from it or for it is current."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import js_types

from lanestream import __version__

PACKAGE = Path(__file__).parents[2] / "client/js"
PAGE_CLIENT = Path(__file__).parents[2] / "service/lanestream/api/static/client"


def npm(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = ["npm", *arguments]
    return subprocess.run(command, cwd=PACKAGE, capture_output=True, text=True, timeout=300)


def test_the_unit_tests() -> None:
    run = npm("run", "--silent", "test")
    assert run.returncode == 0, run.stdout + run.stderr


def test_the_version_is_that_of_the_service() -> None:
    assert json.loads((PACKAGE / "package.json").read_text())["version"] == __version__
    assert json.loads((PACKAGE / "package-lock.json").read_text())["version"] == __version__


def test_the_types_are_current() -> None:
    assert js_types.OUT.read_text() == js_types.types(), "run `make js-types`"


def test_the_modules_of_the_live_page_are_current(tmp_path: Path) -> None:
    build = npm("exec", "--offline", "--", "tsc", "--outDir", str(tmp_path), "--declaration", "false")
    assert build.returncode == 0, build.stdout + build.stderr
    fresh = {path.name: path.read_text() for path in tmp_path.iterdir()}
    committed = {path.name: path.read_text() for path in PAGE_CLIENT.iterdir()}
    assert committed == fresh, "run `make js`"


def test_the_package_holds_what_users_need_and_nothing_else(tmp_path: Path) -> None:
    pack = npm("pack", "--json", "--ignore-scripts", "--pack-destination", str(tmp_path))
    assert pack.returncode == 0, pack.stderr
    (package,) = json.loads(pack.stdout)
    paths = {file["path"] for file in package["files"]}
    assert {"package.json", "README.md", "dist/index.js", "dist/index.d.ts", "src/index.ts"} <= paths
    assert not [path for path in paths if path.startswith(("test", "tools", "node_modules", "."))]
    assert "dependencies" not in json.loads((PACKAGE / "package.json").read_text())
    # Addresses of one registry would be of no use with another one.
    assert '"resolved"' not in (PACKAGE / "package-lock.json").read_text()


def test_the_types_for_users() -> None:
    options = ["--noEmit", "--strict", "--module", "nodenext", "--target", "es2022", "--types", "", "--ignoreConfig"]
    check = npm("exec", "--offline", "--", "tsc", *options, "test/types.ts")
    assert check.returncode == 0, check.stdout
