"""The report's charts, as SVG."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from sklearn.metrics import ConfusionMatrixDisplay, PrecisionRecallDisplay

from lanestream_exporter.evaluation.candidates import clear_candidates
from lanestream_exporter.evaluation.measuring import OVERALL, Evaluation, by_drive
from lanestream_exporter.evaluation.outcomes import Outcome

RULE = "far_40"


@dataclass(frozen=True)
class Chart:
    """A chart with its caption."""

    caption: str
    svg: str = field(repr=False)


def charts(evaluation: Evaluation, figures: Mapping[str, Any]) -> list[Chart]:
    """All charts: those of level A for every classifier, then the error against depth of all methods."""
    images = figures["images"]
    drawn: list[Chart] = []
    for method in evaluation.methods:
        if method.threshold is not None:
            drawn += _of_candidates(method.name, evaluation.images[method.name], images[method.name])
    caption = "Error of the right ego boundaries against the row, single images, all drives"
    return [*drawn, _chart(caption, lambda axes: _draw_depth(axes, images))]


def _of_candidates(name: str, outcomes: Sequence[Outcome], drives: Mapping[str, Any]) -> Iterator[Chart]:
    judged = drives[OVERALL]["candidates"][RULE]
    yield _chart(f"{name}: precision and recall of candidates, by drive", lambda axes: _draw_curves(axes, outcomes))
    yield _chart(
        f"{name}: candidates, all drives, at the model's threshold",
        lambda axes: _draw_confusion(axes, judged["confusion"]),
    )
    yield _chart(
        f"{name}: reliability, all drives, with the count of each bin",
        lambda axes: _draw_reliability(axes, judged["calibration"]["bins"]),
    )
    yield _chart(
        f"{name}: proposal recall against the number of candidates", lambda axes: _draw_proposals(axes, drives)
    )


def _draw_curves(axes: Axes, outcomes: Sequence[Outcome]) -> None:
    for drive, part in by_drive(outcomes).items():
        truth, probability = clear_candidates(part, RULE)
        if truth.any():
            PrecisionRecallDisplay.from_predictions(truth, probability, ax=axes, name=drive)
    axes.set(xlabel="recall", ylabel="precision", xlim=(0.0, 1.02), ylim=(0.0, 1.02))


def _draw_confusion(axes: Axes, counts: Mapping[str, int]) -> None:
    matrix = np.array([[counts["tn"], counts["fp"]], [counts["fn"], counts["tp"]]])
    display = ConfusionMatrixDisplay(matrix, display_labels=["no boundary", "boundary"])
    display.plot(ax=axes, colorbar=False, cmap="Blues", values_format="d")
    axes.set(xlabel="classifier", ylabel="label")


def _draw_reliability(axes: Axes, bins: Sequence[Mapping[str, Any]]) -> None:
    axes.plot([0.0, 1.0], [0.0, 1.0], color="0.7", linewidth=1.0)
    points = [(b["mean_probability"], b["true_share"], b["count"]) for b in bins if b["count"]]
    axes.plot([said for said, _, _ in points], [was for _, was, _ in points], marker="o")
    for said, was, count in points:
        axes.annotate(str(count), (said, was), (4, -10), textcoords="offset points")
    axes.set(xlabel="mean probability", ylabel="share of true ones", xlim=(0.0, 1.05), ylim=(0.0, 1.05))


def _draw_proposals(axes: Axes, drives: Mapping[str, Any]) -> None:
    for place, (drive, part) in enumerate(drives.items()):
        for which, style in (("ego", "-"), ("all", "--")):
            recall = part["candidates"]["proposal_recall"][which]["recall"]
            if recall[0] is not None:
                axes.plot(range(1, len(recall) + 1), recall, style, color=f"C{place}", label=f"{drive}: {which}")
    axes.set(xlabel="candidates of a frame", ylabel="share of labels with a true one", ylim=(0.0, 1.02))
    axes.legend(fontsize=7)


def _draw_depth(axes: Axes, images: Mapping[str, Any]) -> None:
    for name, drives in images.items():
        means = drives[OVERALL]["boundaries"]["ego"]["error_by_depth"]["mean_px_640"]
        shares = (np.arange(len(means)) + 0.5) / len(means)
        axes.plot(shares, [np.nan if mean is None else mean for mean in means], marker=".", label=name)
    axes.set(xlabel="depth: 0 highest labelled row, 1 bottom row", ylabel="mean error, px at 640 wide")
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=7)


def _chart(caption: str, draw: Callable[[Axes], None]) -> Chart:
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": caption, "font.size": 9}):
        drawing = Figure(figsize=(5.2, 3.9), layout="constrained")
        axes = drawing.subplots()
        draw(axes)
        if not axes.images:
            axes.grid(alpha=0.25)
        buffer = io.StringIO()
        drawing.savefig(buffer, format="svg", metadata={"Date": None})
    # Several drawings share the page: what one defines must not be found by another.
    own = re.sub(r"\W+", "-", caption) + "-"
    svg = re.sub(r'(id="|href="#|url\(#)', lambda found: found.group(1) + own, buffer.getvalue())
    return Chart(caption, svg[svg.index("<svg") :])
