"""The HTML report: one self-contained file with tables, charts and the worst frames."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jinja2 import Environment, PackageLoader, select_autoescape
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from sklearn.metrics import ConfusionMatrixDisplay, PrecisionRecallDisplay

from lanestream_exporter.evaluation.bootstrap import SPAN, STILLS
from lanestream_exporter.evaluation.candidates import clear_candidates
from lanestream_exporter.evaluation.gallery import STYLES, gallery
from lanestream_exporter.evaluation.measuring import OVERALL, Evaluation, by_drive
from lanestream_exporter.evaluation.outcomes import RULES, FrameEvaluation
from lanestream_exporter.evaluation.verdicts import HIGH_BASE_RATE, says_little

CHART_RULE = "far_40"


def write_report(folder: Path, evaluation: Evaluation, figures: Mapping[str, Any]) -> Path:
    """Writes `report.html` to `folder`, creating the folder if missing, and returns the path of the file."""
    environment = Environment(
        loader=PackageLoader("lanestream_exporter.evaluation", ""),
        autoescape=select_autoescape(["html", "jinja"]),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["share"] = _share
    environment.filters["interval"] = _interval
    environment.filters["mark"] = lambda base_rate: "*" if says_little(base_rate) else ""
    first = evaluation.methods[0]
    page = environment.get_template("report.html.jinja").render(
        figures=figures,
        rules=list(RULES),
        block={"stills": STILLS, "span": SPAN},
        charts=charts(evaluation, figures),
        high_base_rate=HIGH_BASE_RATE,
        styles=STYLES,
        gallery_method=first.name,
        gallery=gallery(evaluation.evaluation_set, evaluation.images[first.name]),
    )
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _interval(value: list[float] | None) -> str:
    return "" if value is None else f"[{value[0]:.3f}, {value[1]:.3f}]"


@dataclass(frozen=True)
class Chart:
    """A chart as SVG with its caption."""

    caption: str
    svg: str = field(repr=False)


def charts(evaluation: Evaluation, figures: Mapping[str, Any]) -> list[Chart]:
    """Draws all charts: those of level A and of reliability by method, then the error by depth of all methods."""
    images = figures["images"]
    result: list[Chart] = []
    for method in evaluation.methods:
        if method.threshold is not None:
            result += _candidate_charts(method.name, evaluation.images[method.name], images[method.name])
        result += _reliability_charts(method.name, figures)
    caption = "Error of the right ego boundaries by depth, single images, all drives"
    return [*result, _chart(caption, lambda axes: _draw_depth(axes, images))]


def _candidate_charts(name: str, outcomes: Sequence[FrameEvaluation], drives: Mapping[str, Any]) -> Iterator[Chart]:
    judged = drives[OVERALL]["candidates"][CHART_RULE]
    yield _chart(f"{name}: precision and recall of candidates, by drive", lambda axes: _draw_curves(axes, outcomes))
    yield _chart(
        f"{name}: candidates, all drives, at the model's threshold",
        lambda axes: _draw_confusion(axes, judged["confusion"]),
    )
    yield _chart(
        f"{name}: reliability, all drives, with the count of each bin",
        lambda axes: _draw_reliability(axes, judged["calibration"]["bins"]),
    )
    yield _chart(f"{name}: proposal recall by number of candidates", lambda axes: _draw_proposals(axes, drives))


def _reliability_charts(name: str, figures: Mapping[str, Any]) -> Iterator[Chart]:
    parts = {"single images": figures["images"][name][OVERALL], "rendered towns": figures["towns"].get(name)}
    for where, part in parts.items():
        roles = part["reliability"] if part else {}
        if roles:
            caption = f"{name}: reliability of reported boundaries, {where}, with the count of each bin"
            yield _chart(caption, partial(_draw_roles, roles=roles))


def _draw_roles(axes: Axes, roles: Mapping[str, Any]) -> None:
    for role, part in roles.items():
        _draw_reliability(axes, part["calibration"]["bins"], role)
    axes.set(ylabel="share of right reports")
    axes.legend(fontsize=7)


def _draw_curves(axes: Axes, outcomes: Sequence[FrameEvaluation]) -> None:
    for drive, part in by_drive(outcomes).items():
        truth, probability = clear_candidates(part, CHART_RULE)
        if truth.any():
            PrecisionRecallDisplay.from_predictions(truth, probability, ax=axes, name=drive)
    axes.set(xlabel="recall", ylabel="precision", xlim=(0.0, 1.02), ylim=(0.0, 1.02))


def _draw_confusion(axes: Axes, counts: Mapping[str, int]) -> None:
    matrix = np.array([[counts["tn"], counts["fp"]], [counts["fn"], counts["tp"]]])
    display = ConfusionMatrixDisplay(matrix, display_labels=["no boundary", "boundary"])
    display.plot(ax=axes, colorbar=False, cmap="Blues", values_format="d")
    axes.set(xlabel="classifier", ylabel="label")


def _draw_reliability(axes: Axes, bins: Sequence[Mapping[str, Any]], label: str | None = None) -> None:
    axes.plot([0.0, 1.0], [0.0, 1.0], color="0.7", linewidth=1.0)
    points = [(b["mean_probability"], b["true_share"], b["count"]) for b in bins if b["count"]]
    axes.plot([predicted for predicted, _, _ in points], [true for _, true, _ in points], marker="o", label=label)
    for predicted, true, count in points:
        axes.annotate(str(count), (predicted, true), (4, -10), textcoords="offset points")
    axes.set(xlabel="mean probability", ylabel="share of true candidates", xlim=(0.0, 1.05), ylim=(0.0, 1.05))


def _draw_proposals(axes: Axes, drives: Mapping[str, Any]) -> None:
    for index, (drive, part) in enumerate(drives.items()):
        for which, style in (("ego", "-"), ("all", "--")):
            recall = part["candidates"]["proposal_recall"][which]["recall"]
            if recall[0] is not None:
                axes.plot(range(1, len(recall) + 1), recall, style, color=f"C{index}", label=f"{drive}: {which}")
    axes.set(xlabel="candidates per frame", ylabel="share of labels with a true candidate", ylim=(0.0, 1.02))
    axes.legend(fontsize=7)


def _draw_depth(axes: Axes, images: Mapping[str, Any]) -> None:
    for name, drives in images.items():
        means = drives[OVERALL]["boundaries"]["ego"]["error_by_depth"]["mean_px_640"]
        shares = (np.arange(len(means)) + 0.5) / len(means)
        axes.plot(shares, [np.nan if mean is None else mean for mean in means], marker=".", label=name)
    axes.set(xlabel="depth: 0 highest labeled row, 1 bottom row", ylabel="mean error, px at 640 wide")
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=7)


def _chart(caption: str, draw: Callable[[Axes], None]) -> Chart:
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": caption, "font.size": 9}):
        figure = Figure(figsize=(5.2, 3.9), layout="constrained")
        axes = figure.subplots()
        draw(axes)
        if not axes.images:
            axes.grid(alpha=0.25)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    # The charts share a page, so their ids must not collide.
    prefix = re.sub(r"\W+", "-", caption) + "-"
    svg = re.sub(r'(id="|href="#|url\(#)', lambda match: match.group(1) + prefix, buffer.getvalue())
    return Chart(caption, svg[svg.index("<svg") :])
