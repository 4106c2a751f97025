"""Plots of tracking: the bottom row over time with its 95 % band, coverage by state, and error by length of gap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lanestream_exporter.evaluation.tracking.comparison import BOTTOM, ClipRun
from lanestream_exporter.evaluation.tracking.figures import OVERALL
from lanestream_exporter.evaluation.tracking.gaps import LENGTHS
from lanestream_exporter.evaluation.tracking.rendered import Runs
from lanestream_exporter.evaluation.tracking.uncertainty import BAND, STATES

_COLORS: Final = ("#0b6fb8", "#d98c1f")
_TRUTH_COLOR: Final = "#222222"


def write_plots(folder: Path, figures: Mapping[str, Any], runs: Runs) -> list[Path]:
    """Writes all plots to `folder`, creating it if missing, and returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    rendered = figures["rendered"]
    plots = {"coverage": _plot_coverage(rendered), "gaps": _plot_gaps(rendered)}
    # One clip of each kind: its first.
    first = {run.kind: index for index, run in reversed(list(enumerate(next(iter(runs.values())))))}
    for kind, index in first.items():
        plots[f"bottom-{kind}"] = _plot_bottom({name: of_system[index] for name, of_system in runs.items()})
    paths = []
    for name, figure in plots.items():
        paths.append(folder / f"{name}.png")
        figure.savefig(paths[-1])
    return paths


def _plot_bottom(runs: Mapping[str, ClipRun]) -> Figure:
    """Draws the ego boundaries' columns at the bottom row of one clip, with the truth, a panel per system."""
    figure = Figure(figsize=(12.0, 3.6 * len(runs)), dpi=110, layout="constrained")
    for axes, (name, run) in zip(np.ravel([figure.subplots(len(runs), 1, sharex=True)]), runs.items(), strict=True):
        _draw_truth(axes, run)
        for number, track_id in enumerate(_ego_tracks(run)):
            _draw_track(axes, run, track_id, f"C{number % 10}")
        axes.set_title(f"{run.kind} {run.name}: {name}", fontsize=10)
        axes.set_ylabel("column at the bottom row, px")
        axes.set_ylim(-0.1 * run.frames[0].truth.width, 1.1 * run.frames[0].truth.width)
    axes.set_xlabel("seconds")
    return figure


def _draw_truth(axes: Axes, run: ClipRun) -> None:
    times = [frame.truth.timestamp for frame in run.frames]
    for lane_id in sorted({lane.lane_id for frame in run.frames for lane in frame.truth.lanes}):
        columns = [
            next(
                (x[BOTTOM] for lane, x in zip(f.truth.lanes, f.true_x, strict=True) if lane.lane_id == lane_id), np.nan
            )
            for f in run.frames
        ]
        axes.plot(times, columns, color=_TRUTH_COLOR, linewidth=0.8, linestyle="--")


def _draw_track(axes: Axes, run: ClipRun, track_id: int, color: str) -> None:
    values = np.full((len(run.frames), 2), np.nan)
    for row, frame in enumerate(run.frames):
        for index, lane in enumerate(frame.answer.lanes):
            if lane.track_id == track_id:
                values[row] = frame.x[index, BOTTOM], frame.sigma[index, BOTTOM]
    times = np.array([frame.truth.timestamp for frame in run.frames])
    x, sigma = values.T
    axes.plot(times, x, color=color, linewidth=1.2, label=f"track {track_id}")
    axes.fill_between(times, x - BAND * sigma, x + BAND * sigma, color=color, alpha=0.25, linewidth=0.0)


def _ego_tracks(run: ClipRun) -> Sequence[int]:
    return sorted({lane.track_id for frame in run.frames for lane in frame.answer.lanes if abs(lane.position) == 1})


def _plot_coverage(rendered: Mapping[str, Any]) -> Figure:
    figure = Figure(figsize=(8.0, 3.6), dpi=110, layout="constrained")
    for axes, row in zip(figure.subplots(1, 2, sharey=True), ("bottom", "far"), strict=True):
        for number, (name, kinds) in enumerate(rendered.items()):
            shares = [kinds[OVERALL]["uncertainty"][state]["coverage"][row]["share"] for state in STATES]
            places = np.arange(len(STATES)) + 0.4 * (number - 0.5 * (len(rendered) - 1))
            axes.bar(places, [share or 0.0 for share in shares], 0.36, color=_COLORS[number % 2], label=name)
        axes.axhspan(0.90, 0.98, color="#888888", alpha=0.3)
        axes.set_xticks(range(len(STATES)), STATES)
        axes.set_title(f"coverage of the 95 % band, {row}", fontsize=10)
    axes.legend(fontsize=8)
    return figure


def _plot_gaps(rendered: Mapping[str, Any]) -> Figure:
    figure = Figure(figsize=(8.0, 3.6), dpi=110, layout="constrained")
    errors, ids = figure.subplots(1, 2)
    for number, (name, kinds) in enumerate(rendered.items()):
        gaps, color = kinds[OVERALL]["gaps"], _COLORS[number % 2]
        lengths = [length for length in LENGTHS if gaps[str(length)]["gaps"]]
        for key, style in (("median_end_error", "-"), ("p90_end_error", ":")):
            values = [np.nan if (value := gaps[str(n)][key]) is None else value for n in lengths]
            errors.plot(lengths, values, style, marker="o", color=color, label=f"{name}, {key.split('_')[0]}")
        ids.plot(lengths, [gaps[str(n)]["same_id_share"] for n in lengths], marker="o", color=color, label=name)
    errors.set_ylabel("error at the end of the gap, lane widths")
    ids.set_ylabel("share with the same id after the gap")
    ids.set_ylim(0.0, 1.05)
    for axes in (errors, ids):
        axes.set_xlabel("hidden frames")
        if axes.lines:
            axes.legend(fontsize=8)
    return figure
