"""How a run went: one row a check, as a table and as a picture."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

Row = dict[str, float]


def write_curve(folder: Path, rows: Sequence[Row]) -> None:
    """Writes `curve.csv` and `curve.png`; each row has `step`, `rate`, `loss` and the figures of validation."""
    with (folder / "curve.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    _drawn(rows).savefig(folder / "curve.png", dpi=120)


def _drawn(rows: Sequence[Row]) -> Figure:
    """The losses above, every other figure of validation below."""
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True)
    steps = [row["step"] for row in rows]
    for name in rows[0]:
        if name not in ("step", "rate"):
            axes = above if name in ("loss", "validation") or name.endswith("loss") else below
            axes.plot(steps, [row[name] for row in rows], marker=".", label=name.replace("_", " "))
    above.set_ylabel("loss")
    below.set_ylabel("validation")
    below.set_xlabel("step")
    for axes in (above, below):
        axes.grid(alpha=0.3)
        if axes.lines:
            axes.legend()
    return figure
