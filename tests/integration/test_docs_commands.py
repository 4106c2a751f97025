"""The commands and programs in the README and in docs/ run as written, each page in a folder with small stand-ins.

What can't run here is listed with the reason. Synopses are compared with the options that the commands really have.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

import click
import httpx
import numpy as np
import pytest
import yaml
from docpages import PAGES, ROOT, SHELL, Block, blocks, commands, synopses
from train_toy import draw_drive

from lanestream.cli import cli
from lanestream.keys import new_key
from lanestream_exporter.scenes import sample_clip, write_clip

DOCKER = "needs a container engine; `make image-test` and `make up-check` check it"
LONG = "takes too long"
SYSTEM = "changes the system; the tests of the unit are in tests/unit/deploy"
ANY = "any page"
# What does not run here: the page, a pattern of the command or program, and why.
NOT_RUN = [
    (ANY, "pip install *", "installs a release"),
    (ANY, "git clone *", "is how this copy came here"),
    (ANY, "python3 -m venv *", "`make test` does the same; tests/integration/test_wheel.py checks the package"),
    ("CONTRIBUTING.md", "make *", "checks the repository itself; CI runs both"),
    ("CONTRIBUTING.md", ".venv/bin/python -m pytest *", "is a part of the tests"),
    ("docs/batch.md", "*", "tests/integration/test_batch.py"),
    ("docs/benchmarks.md", "make bench*", f"{LONG}; tests/integration/test_bench.py runs a part"),
    ("docs/benchmarks.md", "* -m bench.report", "reads what `make bench` wrote"),
    ("docs/cameras.md", "lanestream calibrate *", f"{LONG}; tests/unit/exporter/test_camera_calibration.py"),
    ("docs/capacity.md", "make capacity*", f"{LONG}; tests/integration/test_capacity.py runs a part"),
    ("docs/capacity.md", "make bench", f"{LONG}; tests/integration/test_bench.py runs a part"),
    ("docs/capacity.md", "* -m capacity *", "tests/unit/tools/test_capacity.py and tests/integration/test_capacity.py"),
    ("docs/client.md", "from lanestream_client import *open_source*", "tests/integration/test_network_cameras.py"),
    ("docs/client.md", "from pathlib import Path*", "tests/integration/test_clients.py"),
    ("docs/client.md", "import asyncio*", "tests/integration/test_clients.py"),
    ("docs/client.md", "import cv2*", "tests/integration/test_clients.py"),
    ("docs/client.md", "import rerun*", "tests/integration/test_clients.py"),
    ("docs/cluster.md", "*", "needs Ray; tests/integration/test_cluster.py and tests/integration/test_cluster_up.py"),
    ("docs/deployment.md", "lanestream serve * --tls-certificate *", "tests/integration/test_tls.py"),
    ("docs/deployment.md", "make up*", DOCKER),
    ("docs/deployment.md", "apt install *", DOCKER),
    ("docs/deployment.md", "pipx install *", DOCKER),
    ("docs/deployment.md", "make image*", DOCKER),
    ("docs/deployment.md", "docker *", DOCKER),
    ("docs/deployment.md", "LANESTREAM_PUBLISH=* docker/compose *", DOCKER),
    ("docs/deployment.md", "*/opt/lanestream*", SYSTEM),
    ("docs/deployment.md", "*/etc/lanestream*", SYSTEM),
    ("docs/deployment.md", "cp * /etc/systemd/*", SYSTEM),
    ("docs/deployment.md", "systemctl *", SYSTEM),
    ("docs/deployment.md", "journalctl *", SYSTEM),
    ("docs/exporting.md", "lanestream export alexnet.pt *", "tests/unit/exporter/exporting/test_export_parts.py"),
    ("docs/index.md", "lanestream stream my_drive.mp4 *", "is the first command of the quick start"),
    ("docs/javascript.md", "*", "tests/browser/test_js_client.py"),
    ("docs/kubernetes.md", "*", "needs a cluster and a registry; the tests of the chart are in tests/unit/deploy"),
    ("docs/labeling.md", "lanestream *", "tests/integration/test_label_command.py"),
    ("docs/operations.md", "curl -X POST *", "needs a service with keys; tests/integration/test_access.py"),
    ("docs/operations.md", "new WebSocket(*", "one line of a web page; tests/integration/test_access.py"),
    ("docs/protocol.md", "new WebSocket(*", "one line of a web page; tests/integration/test_access.py"),
    ("docs/providers.md", "make gpu-check*", "needs an NVIDIA GPU; tests/integration/test_gpu_check.py"),
    ("docs/providers.md", "python tools/gpu_check.py*", "needs an NVIDIA GPU; tests/integration/test_gpu_check.py"),
    ("docs/quickstart.md", "lanestream stream 0 *", "needs a camera; tests/integration/test_network_cameras.py"),
    ("docs/security.md", "make attack*", f"{LONG}; tests/integration/test_attacks.py runs a part"),
    ("docs/training.md", "* classifier-finetune*", f"{LONG}; the same commands run with classifier-trial"),
    ("docs/training.md", "* runs/mine/best.pt *", "needs that training"),
    ("docs/training.md", "lanestream * --model mine.onnx*", "needs that training"),
    ("docs/training.md", "lanestream train regressor *", LONG),
    ("docs/training.md", "lanestream export runs/my-regressor/*", "needs that training"),
    ("docs/training.md", "lanestream train classifier finetune.toml *", LONG),
]
# Commands that fail on purpose on machines without a GPU, and what they then print.
FAILING = {"lanestream doctor --require cuda >/dev/null": "error: the installed onnxruntime has no CUDA"}
# What commands print, as a regular expression.
PRINTED = {
    "curl --data-binary @road.jpg *": r'"lanes":\[{"track_id"',
    "lanestream evaluate --model trial.onnx *": r"(?s)\btrial \d.*lanestream-alexnet \d",
    "lanestream stream my_drive.mp4 --url *": r"answered, 0 dropped, 0 failed",
    "import { readFile }*": "type: 'lanes'",
}
# Blocks in these languages are data or belong to other programs.
NOT_CODE = {"caddyfile", "dockerfile", "haproxy", "html", "json", "nginx", "text", "toml", "yaml"}
# Commands that are safe to run. Others must be listed above.
SAFE = {"curl", "head", "lanestream", "make"}
# With Node 20 `WebSocket` is an option.
PROGRAMS = {
    "python": (sys.executable, "-c"),
    "js": ("node", "--experimental-websocket", "--input-type=module", "--eval"),
}
SHELL_PROGRAM = ("bash", "-euo", "pipefail", "-c")
READY_S = 60.0
COMMAND_S = 200.0


def reason_not_to_run(page: str, code: str) -> str | None:
    """Returns why the code of a page does not run here; None if it does."""
    return next((why for where, pattern, why in NOT_RUN if where in (page, ANY) and fnmatchcase(code, pattern)), None)


def pieces(page: str) -> Iterator[tuple[Block, str]]:
    """Yields the commands and programs of a page, which run or are listed above."""
    for block in blocks(page):
        if block.language in SHELL and not block.is_synopsis:
            yield from ((block, command) for command in commands(block))
        elif block.language not in SHELL | NOT_CODE:
            yield block, block.text


def is_safe(block: Block, code: str) -> bool:
    """Whether a block's program or command may run here, whatever someone writes into the documentation."""
    return block.language in PROGRAMS or re.sub(r"^([A-Z_]+=\S+ )*", "", code).split()[0] in SAFE


RUNNING = [page for page in PAGES if any(reason_not_to_run(page, code) is None for _, code in pieces(page))]
SYNOPSES = [(page, line) for page in PAGES for block in blocks(page) if block.is_synopsis for line in synopses(block)]


def test_what_does_not_run_still_exists() -> None:
    for page, pattern, why in NOT_RUN:
        pages = PAGES if page == ANY else [page]
        found = any(fnmatchcase(code, pattern) for each in pages for _, code in pieces(each))
        assert found, f"{page} no longer has {pattern!r}"
        for path in re.findall(r"tests/\S+\.py", why):
            assert (ROOT / path).exists(), path
    for pattern in [*FAILING, *PRINTED]:
        assert any(fnmatchcase(code, pattern) for page in PAGES for _, code in pieces(page)), pattern


@pytest.fixture(scope="module")
def stand_ins(tmp_path_factory: pytest.TempPathFactory, road: bytes) -> Path:
    """Returns a folder with everything that the pages take for given."""
    folder = tmp_path_factory.mktemp("stand-ins")
    (folder / "road.jpg").write_bytes(road)
    (folder / "camera.json").write_text('{"height": 1.4, "field_of_view": 62}')
    scene = sample_clip(np.random.default_rng(24), 640, 360, frames=12, fps=25.0)
    write_clip(scene, folder / "my_drive.mp4", folder / "my_drive.jsonl")
    shutil.copy(folder / "my_drive.mp4", folder / "drive.mp4")
    for seed, drive in enumerate(("my_roads/monday", "my_roads/tuesday", "my_test_roads/wednesday")):
        draw_drive(folder / drive, seed, frames=4)
    (folder / "keys").write_text(str(new_key("camera-7")[1]))
    (folder / ".curlrc").write_text("fail-with-body\n")  # a refusal is a failure
    (folder / "docker" / "secrets").mkdir(parents=True)
    (folder / "docker" / "secrets" / "local_key").write_text("lane_key")
    for name in ("Makefile", "pyproject.toml", "tools"):
        (folder / name).symlink_to(ROOT / name)
    return folder


@dataclass
class Reader:
    """Someone who follows a page: their folder, and the port of the service that they started last."""

    folder: Path
    port: int
    stack: ExitStack

    def follow(self, block: Block, code: str) -> None:
        """Runs a command or a program as the page shows it."""
        where = f"{block.page}:{block.line}"
        assert is_safe(block, code), where
        code = re.sub(r"127\.0\.0\.1:8000|10\.0\.0\.[56]:8000", f"127.0.0.1:{self.port}", code)
        if re.match(r"([A-Z_]+=\S+ )*lanestream serve(?!.*--print-config)", code):
            self.port = self.stack.enter_context(serving(code, self.folder))
            return
        if code in FAILING and shutil.which("nvidia-smi"):
            return
        program = [*PROGRAMS.get(block.language, SHELL_PROGRAM), code]
        result = subprocess.run(
            program,
            cwd=self.folder,
            env=environment(CURL_HOME=str(self.folder)),
            capture_output=True,
            text=True,
            check=False,
            timeout=COMMAND_S,
        )
        shown = f"{where}: {code}\n{result.stdout[-3000:]}\n{result.stderr[-3000:]}"
        assert "Traceback" not in result.stderr, shown
        if code in FAILING:
            assert result.returncode == 1, shown
            assert FAILING[code] in result.stderr, shown
        else:
            assert result.returncode == 0, shown
        for pattern, expected in PRINTED.items():
            assert not fnmatchcase(code, pattern) or re.search(expected, result.stdout), f"no {expected}: {shown}"


def environment(**more: str) -> dict[str, str]:
    """Returns the environment of the commands: this Python's commands first, and no data of this machine."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return {name: value for name, value in os.environ.items() if name != "LANESTREAM_DATA"} | {"PATH": path} | more


@contextmanager
def serving(command: str, folder: Path) -> Iterator[int]:
    """Runs a `lanestream serve` on a free port, which it yields, until it is no longer needed."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    variables = environment(LANESTREAM_PORT=str(port), LANESTREAM_PROCESSES="1")
    with (folder / "service.log").open("w") as log:
        process = subprocess.Popen(
            [shutil.which("bash") or "bash", "-c", f"exec env {command}"],
            cwd=folder,
            env=variables,
            stdout=log,
            stderr=log,
        )
        try:
            wait_until_ready(process, port, folder / "service.log")
            yield port
        finally:
            process.terminate()
            process.wait(timeout=30)


def wait_until_ready(process: subprocess.Popen[bytes], port: int, log: Path) -> None:
    end = time.monotonic() + READY_S
    while process.poll() is None and time.monotonic() < end:
        try:
            if httpx.get(f"http://127.0.0.1:{port}/readyz").is_success:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    pytest.fail(f"the service did not get ready:\n{log.read_text()}")


@pytest.fixture(scope="module")
def service_port(stand_ins: Path) -> Iterator[int]:
    """Returns the port of a service for pages that take a running one for given."""
    with serving("lanestream serve", stand_ins) as port:
        yield port


@pytest.mark.parametrize("page", RUNNING)
def test_the_commands_of_a_page_run(page: str, stand_ins: Path, service_port: int, tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    shutil.copytree(stand_ins, folder, symlinks=True)
    make_environment(folder / ".venv")
    for block in blocks(page):
        if block.file_name:
            (folder / block.file_name).write_text(block.text.replace("/etc/lanestream/keys", "keys"))
    with ExitStack() as stack:
        reader = Reader(folder, service_port, stack)
        for block, code in pieces(page):
            if reason_not_to_run(page, code) is None:
                reader.follow(block, code)


def make_environment(folder: Path) -> None:
    """Makes a folder that `make` takes for the environment that it has set up: this one."""
    folder.mkdir()
    for name in ("bin", "lib", "pyvenv.cfg"):
        (folder / name).symlink_to(Path(sys.prefix) / name)
    for name in (".ready-run", ".ready-dev"):
        (folder / name).touch()


@pytest.mark.parametrize(
    "block",
    [block for page in PAGES for block in blocks(page) if block.language in {"json", "toml", "yaml"}],
    ids=lambda block: f"{block.page}:{block.line}",
)
def test_data_is_valid(block: Block) -> None:
    {"json": json.loads, "toml": tomllib.loads, "yaml": yaml.safe_load}[block.language](block.text)


@pytest.mark.parametrize(("page", "line"), SYNOPSES, ids=lambda value: value[:40])
def test_a_synopsis_has_only_real_options(page: str, line: str) -> None:
    for command, words in called(line.replace("[", " ").replace("]", " ").split()[1:], cli):
        options = {name: option for option in command.params for name in option.opts}
        for at, word in enumerate(words):
            name = word.removesuffix("...")
            if not name.startswith("-"):
                continue
            assert name in options, f"{page}: {command.name} has no option {name}"
            kind = options[name].type
            values = words[at + 1].split("|") if at + 1 < len(words) else []
            if isinstance(kind, click.Choice) and len(values) > 1:
                shown = set(values) - {"..."}
                assert shown <= set(kind.choices), f"{page}: {name} does not accept {shown - set(kind.choices)}"
                assert "..." in values or shown == set(kind.choices), f"{page}: {name} also accepts others"


def called(words: list[str], command: click.Command) -> Iterator[tuple[click.Command, list[str]]]:
    """Yields the commands that `words` call, such as two for `train classifier|regressor`, each with its own words."""
    names = words[0].split("|") if words and isinstance(command, click.Group) else []
    context = click.Context(command)
    found = [command.get_command(context, name) for name in names] if isinstance(command, click.Group) else []
    if not found or None in found:
        yield command, words
        return
    for each in found:
        assert each is not None
        yield from called(words[1:], each)


def test_every_command_is_documented() -> None:
    in_synopses = {command for _, line in SYNOPSES for command, _ in called(line.replace("[", " ").split()[1:], cli)}
    text = "\n".join((ROOT / page).read_text(encoding="utf-8") for page in PAGES)
    missing = [name for name, command in leaves("lanestream", cli) if command not in in_synopses and name not in text]
    assert missing == []


def leaves(name: str, command: click.Command) -> Iterator[tuple[str, click.Command]]:
    """Yields all commands below a group, with their names."""
    if not isinstance(command, click.Group) or command.invoke_without_command:
        yield name, command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for sub in command.list_commands(context):
            found = command.get_command(context, sub)
            assert found is not None
            yield from leaves(f"{name} {sub}", found)
