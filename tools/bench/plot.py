"""The picture of a benchmark: throughput, the time from frame to reply, and frame age under too much load."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.plan import LITSERVE, NAIVE, PIPELINE, SERVICE

_LOOKS: Final = {
    PIPELINE: ("one process, no service", "#8a8f98", "--"),
    SERVICE: ("Lanestream service", "#0b6fb8", "-"),
    LITSERVE: ("LitServe, our detector", "#d98c1f", "-"),
    NAIVE: ("naive service", "#b03a2e", "-"),
}


def plot(told: Mapping[str, Any], path: Path) -> None:
    """Writes the picture of what `figures` told to `path`, a PNG file."""
    figure = Figure(figsize=(13.0, 4.2), dpi=130, layout="constrained")
    rates, times, ages = figure.subplots(1, 3, width_ratios=(1.15, 0.9, 1.15))
    _rates(rates, told)
    _times(times, told)
    _ages(ages, told)
    machine = told["machine"]
    figure.suptitle(
        f"1280 x 720 JPEG to lanes, {machine['processors']} processors ({machine['processor']}), "
        f"{told['provider']}, {told['candidates_per_frame']:g} candidates a frame",
        fontsize=10,
    )
    figure.savefig(path)


def _cells(told: Mapping[str, Any], name: str, in_flight: int) -> list[Mapping[str, Any]]:
    return [
        cell
        for cell in told["cells"]
        if (cell["contestant"], cell["size"], cell["in_flight"], cell["detector"])
        == (name, "1280x720", in_flight, "candidates")
    ]


def _rates(axes: Axes, told: Mapping[str, Any]) -> None:
    for name, (label, colour, style) in _LOOKS.items():
        cells = _cells(told, name, 2)
        sessions = [cell["sessions"] for cell in cells]
        rates = [cell["fps"]["median"] for cell in cells]
        axes.plot(sessions, rates, style, marker="o", color=colour, label=label)
    axes.set_xscale("log", base=2)
    counts = sorted({cell["sessions"] for cell in _cells(told, SERVICE, 2)})
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.set_ylim(bottom=0.0)
    axes.set(title="Throughput: higher is better", xlabel="cameras at a time", ylabel="frames a second, all together")
    axes.legend(fontsize=8, loc="center right", bbox_to_anchor=(1.0, 0.52))
    axes.grid(alpha=0.3)


def _times(axes: Axes, told: Mapping[str, Any]) -> None:
    rows = [(name, cell) for name in (SERVICE, LITSERVE, NAIVE) for cell in _cells(told, name, 1) if cell["p50_ms"]]
    for place, (name, cell) in enumerate(rows):
        axes.bar(place, cell["p50_ms"], color=_LOOKS[name][1], width=0.6)
        axes.vlines(place, cell["p50_ms"], cell["p95_ms"], color="black", linewidth=1.2)
        axes.annotate(f"{cell['p50_ms']:.0f}", (place, cell["p95_ms"]), (0, 3), textcoords="offset points", ha="center")
    axes.set_xticks(range(len(rows)), [_LOOKS[name][0].replace(" ", "\n", 1) for name, _ in rows], fontsize=8)
    axes.margins(y=0.12)  # room for the highest bar's number
    axes.set(title="One camera: lower is better", ylabel="ms from frame to reply: median, and p95")
    axes.grid(alpha=0.3, axis="y")


def _ages(axes: Axes, told: Mapping[str, Any]) -> None:
    soak, unloaded = told["soak"], told["median_ms_720p_classifier"]
    ages = soak["p95_age_ms_by_second"]
    axes.plot(range(len(ages)), ages, color=_LOOKS[SERVICE][1], label="p95 of each second")
    axes.axhline(unloaded, color="black", linewidth=1.0, label="median without load")
    axes.axhline(3.0 * unloaded, color="black", linewidth=1.0, linestyle=":", label="3 times that")
    axes.set_ylim(bottom=0.0)
    times = soak["pushed_fps"] / max(soak["fps"], 1e-9)
    axes.set(
        title=f"{soak['clients']} cameras push {times:.1f} x what is answered",
        xlabel="seconds",
        ylabel="frame age at its answer, ms (mode latest)",
    )
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
