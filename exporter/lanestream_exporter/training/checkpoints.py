"""Checkpoints: written whole or not at all, read without running any code of theirs, and telling what made them."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import torch

from lanestream import __version__
from lanestream.errors import CheckpointError
from lanestream_exporter.alexnet import load_state


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Saves whole or not at all, so that a run that is cut off can go on."""
    unfinished = path.with_suffix(".part")
    torch.save(state, unfinished)
    unfinished.replace(path)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint of a run with its `network`. Raises CheckpointError with what to do about it."""
    state = load_state(path)
    if "network" not in state:
        raise CheckpointError(f"{path} is not a checkpoint of this trainer", "give the best.pt of a run")
    return state


def made_by() -> dict[str, Any]:
    """The versions of the program and of PyTorch, and the program's git revision where it runs from a checkout."""
    return {"lanestream": __version__, "torch": str(torch.__version__), "revision": revision()}


def revision() -> str | None:
    """The git revision of this program, with `-dirty` where files were changed; None outside a checkout of it."""
    # Installed into somebody's project, the files lie in a repository of that project, or in none.
    if _git("ls-files", "--error-unmatch", Path(__file__).name) is None:
        return None
    return _git("describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")


def _git(*arguments: str) -> str | None:
    command = ["git", "-C", str(Path(__file__).parent), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
