"""The files of a run: checkpoints, which are written atomically and say what made them, and the learning curve."""

from __future__ import annotations

import csv
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lanestream import __version__
from lanestream.errors import CheckpointError
from lanestream.writing import writing
from lanestream_exporter.weight_files import load_state

CurveRow = dict[str, float]


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Writes a checkpoint atomically, so that a run can continue after a crash. Raises SourceError if it can't."""
    unfinished = path.with_suffix(".part")
    with writing(path):
        try:
            with unfinished.open("wb") as file:
                torch.save(state, file)
        except RuntimeError as error:
            unfinished.unlink()
            # This is how torch reports that the disk is full.
            raise (error.__context__ if isinstance(error.__context__, OSError) else error) from None
        unfinished.replace(path)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Returns a checkpoint of a run, with its `network`. Raises CheckpointError for any other file."""
    state = load_state(path)
    if "network" not in state:
        raise CheckpointError(f"{path} is not a checkpoint of this trainer", "give the best.pt of a run")
    return state


def made_by() -> dict[str, Any]:
    """Returns the versions of the program and of PyTorch, and the git revision if it runs from a checkout."""
    return {"lanestream": __version__, "torch": str(torch.__version__), "revision": revision()}


def revision() -> str | None:
    """Returns the git revision of this program, with `-dirty` if files are changed; None outside a checkout of it."""
    # An installed package may lie in the repository of another project.
    if _git("ls-files", "--error-unmatch", Path(__file__).name) is None:
        return None
    return _git("describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")


def _git(*arguments: str) -> str | None:
    command = ["git", "-C", str(Path(__file__).parent), *arguments]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip()


def write_curve(folder: Path, rows: Sequence[CurveRow]) -> None:
    """Writes `curve.csv` and `curve.png`; each row has `step`, `rate`, `loss` and the validation figures."""
    with (folder / "curve.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    _plot(rows).savefig(folder / "curve.png", dpi=120)


def _plot(rows: Sequence[CurveRow]) -> Figure:
    """Returns a figure with the losses on top and every other validation figure below."""
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    top, bottom = figure.subplots(2, 1, sharex=True)
    steps = [row["step"] for row in rows]
    for name in rows[0]:
        if name not in ("step", "rate"):
            axes = top if name in ("loss", "validation") or name.endswith("loss") else bottom
            axes.plot(steps, [row[name] for row in rows], marker=".", label=name.replace("_", " "))
    top.set_ylabel("loss")
    bottom.set_ylabel("validation")
    bottom.set_xlabel("step")
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
        if axes.lines:
            axes.legend()
    return figure
