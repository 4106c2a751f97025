"""The figure of a benchmark: throughput, time from frame to reply, and frame age under overload."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.workload import BASELINE, LITSERVE, PIPELINE, SERVICE

# The label, color and line style of each runner.
_STYLES: Final = {
    PIPELINE: ("one process, no service", "#8a8f98", "--"),
    SERVICE: ("Lanestream service", "#0b6fb8", "-"),
    LITSERVE: ("LitServe, our detector", "#d98c1f", "-"),
    BASELINE: ("baseline service", "#b03a2e", "-"),
}
_KEYS: Final = ("runner", "size", "in_flight", "detector")


def plot(report: Mapping[str, Any], path: Path) -> None:
    """Writes the figure of a report to `path`, a PNG file."""
    figure = Figure(figsize=(13.0, 4.2), dpi=130, layout="constrained")
    throughput, latency, age = figure.subplots(1, 3, width_ratios=(1.15, 0.9, 1.15))
    _plot_throughput(throughput, report)
    _plot_latency(latency, report)
    _plot_age(age, report)
    figure.suptitle(title(report), fontsize=10)
    figure.savefig(path)


def title(report: Mapping[str, Any]) -> str:
    """Returns the figure's title: what was measured, in which version and on which processor."""
    machine, version = report["machine"], report["versions"]["lanestream"]
    rounds = report["rounds"]
    return (
        f"Lanestream {version}, 1280 x 720 JPEG to lanes, {report['candidates_per_frame']:g} candidates per frame\n"
        f"{machine['processors']} processors ({machine['processor']}), {report['provider']}, "
        f"{rounds} {'round' if rounds == 1 else 'rounds'}"
    )


def _workloads(report: Mapping[str, Any], runner: str, in_flight: int) -> list[Mapping[str, Any]]:
    wanted = (runner, "1280x720", in_flight, "candidates")
    return [row for row in report["workloads"] if tuple(row[key] for key in _KEYS) == wanted]


def _plot_throughput(axes: Axes, report: Mapping[str, Any]) -> None:
    for runner, (label, color, style) in _STYLES.items():
        rows = _workloads(report, runner, 2)
        if rows:
            sessions = [row["sessions"] for row in rows]
            axes.plot(sessions, [row["fps"]["median"] for row in rows], style, marker="o", color=color, label=label)
    axes.set_xscale("log", base=2)
    counts = sorted({row["sessions"] for row in _workloads(report, SERVICE, 2)})
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.set_ylim(bottom=0.0)
    axes.set(title="Throughput: higher is better", xlabel="simultaneous cameras", ylabel="frames per second, in total")
    axes.legend(fontsize=8, loc="best")
    axes.grid(alpha=0.3)


def _plot_latency(axes: Axes, report: Mapping[str, Any]) -> None:
    runners = (SERVICE, LITSERVE, BASELINE)
    rows = [(runner, row) for runner in runners for row in _workloads(report, runner, 1) if row["p50_ms"]]
    for index, (runner, row) in enumerate(rows):
        axes.bar(index, row["p50_ms"], color=_STYLES[runner][1], width=0.6)
        axes.vlines(index, row["p50_ms"], row["p95_ms"], color="black", linewidth=1.2)
        axes.annotate(f"{row['p50_ms']:.0f}", (index, row["p95_ms"]), (0, 3), textcoords="offset points", ha="center")
    axes.set_xticks(range(len(rows)), [_STYLES[runner][0].replace(" ", "\n", 1) for runner, _ in rows], fontsize=8)
    axes.margins(y=0.12)  # room for the number on the highest bar
    axes.set(title="One camera: lower is better", ylabel="ms from frame to reply: median, and p95")
    axes.grid(alpha=0.3, axis="y")


def _plot_age(axes: Axes, report: Mapping[str, Any]) -> None:
    soak, unloaded = report["soak"], report["median_ms_720p_classifier"]
    ages = soak["p95_age_ms_by_second"]
    axes.plot(range(len(ages)), ages, color=_STYLES[SERVICE][1], label="p95 of each second")
    axes.axhline(unloaded, color="black", linewidth=1.0, label="median without load")
    axes.axhline(3.0 * unloaded, color="black", linewidth=1.0, linestyle=":", label="3 times that")
    axes.set_ylim(bottom=0.0)
    factor = soak["pushed_fps"] / max(soak["fps"], 1e-9)
    axes.set(
        title=f"{soak['clients']} cameras push {factor:.1f} times what is answered",
        xlabel="seconds",
        ylabel="frame age at its reply, ms (mode latest)",
    )
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
