"""The help of every command works with any set of extras, and so do its usage errors."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.metadata import packages_distributions, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement

# Hides top-level modules, then prints the help of every command and subcommand, as JSON.
EVERY_HELP = """
import json, sys
from importlib.abc import MetaPathFinder
from click.testing import CliRunner
import click

hidden = json.loads(sys.argv[1])

class Hidden(MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.partition(".")[0] in hidden:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Hidden())
from lanestream.cli import cli

def commands(command, path):
    yield path
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            yield from commands(command.get_command(context, name), [*path, name])

helps = {}
for path in commands(cli, []):
    result = CliRunner().invoke(cli, [*path, "--help"])
    helps[" ".join(path)] = result.output if result.exit_code == 0 else f"failed: {result.exception!r}"
json.dump(helps, sys.stdout)
"""
RUN = EVERY_HELP.partition("def commands")[0] + "from lanestream.cli import main; sys.argv[1:2] = []; main()"


def optional_modules() -> list[str]:
    """Returns the installed top-level modules that `pip install lanestream` alone does not install."""
    distributions, todo = {"lanestream"}, ["lanestream"]
    while todo:
        for line in requires(todo.pop()) or ():
            requirement = Requirement(line)
            name = requirement.name.lower().replace("_", "-")
            if name not in distributions and (requirement.marker is None or requirement.marker.evaluate({"extra": ""})):
                distributions.add(name)
                todo.append(name)
    owners = packages_distributions().items()
    return [name for name, by in owners if not {each.lower().replace("_", "-") for each in by} & distributions]


OPTIONAL = optional_modules()


def run(script: str, hidden: list[str], *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", script, json.dumps(hidden), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


@pytest.mark.parametrize(
    "hidden",
    [OPTIONAL, ["numpy"], ["cv2"], ["onnxruntime"], ["fastapi"], ["torch"]],
    ids=["all", "numpy", "cv2", "onnxruntime", "fastapi", "torch"],
)
def test_every_command_has_help(hidden: list[str]) -> None:
    result = run(EVERY_HELP, hidden)
    assert result.returncode == 0, result.stderr
    helps = json.loads(result.stdout)
    expected = {"", "serve", "cluster up", "models", "stream", "train classifier", "evaluate tracking", "data check"}
    assert expected <= set(helps)
    for path, text in helps.items():
        assert text.startswith(f"Usage: cli {path}".rstrip()), f"{path}: {text}"


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        ("serve", "service,cpu"),
        ("cluster up", "cluster,cpu"),
        ("doctor", "service,cpu"),
        ("models", "service,cpu"),
        ("detect x.jpg", "service,cpu"),
        ("stream 0", "video"),
        ("scene x.mp4", "video"),
        ("calibrate x --height 1.4 -o camera.json", "service,cpu"),
        ("data check x", "data"),
        ("label x out --format cvat", "data,service,cpu"),
        ("train classifier --run x", "train,service,cpu"),
        ("export x.pt x.onnx", "export,service,cpu"),
        ("evaluate", "export,service,cpu"),
        ("evaluate tracking", "export,service,cpu"),
        ("score x y", "data"),
    ],
)
def test_without_its_extra_a_command_says_what_to_install(arguments: str, extra: str) -> None:
    result = run(RUN, OPTIONAL, *arguments.split())
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr.startswith("error: this needs the package ")
    assert result.stderr.endswith(f", which is not installed (pip install 'lanestream[{extra}]')\n")


@pytest.mark.parametrize("arguments", ["models", "doctor", f"detect {__file__}", "serve --port 0"])
def test_onnxruntime_may_be_the_only_one_missing(arguments: str, tmp_path: Path) -> None:
    missing = "raise ModuleNotFoundError(\"No module named 'onnxruntime'\", name='onnxruntime')"
    (tmp_path / "onnxruntime.py").write_text(missing)
    paths = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "lanestream", *arguments.split()]
    environment = {**os.environ, "PYTHONPATH": paths}
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60, env=environment)
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    error = result.stderr.splitlines()[-1]
    assert error.startswith(
        "error: this needs the package onnxruntime, which is not installed (pip install 'lanestream["
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("evaluate --split none", "'none' is not one of 'train', 'val', 'test'"),
        ("scene x.mp4 --style moon", "'moon' is not one of 'highway', "),
        ("export x.pt x.onnx --precision int4", "'int4' is not one of 'fp32', 'fp16', 'int8'"),
        ("train classifier", "Missing option '--run'"),
        ("stream", "Missing argument 'SOURCE'"),
    ],
)
def test_usage_errors_need_no_extra(arguments: str, message: str) -> None:
    result = run(RUN, OPTIONAL, *arguments.split())
    assert (result.returncode, result.stdout) == (2, "")
    assert message in result.stderr


def test_the_module_is_the_command() -> None:
    command = [sys.executable, "-m", "lanestream", "--version"]
    result = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert result.stdout.startswith("lanestream ")
