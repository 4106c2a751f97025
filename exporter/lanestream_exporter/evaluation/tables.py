"""Tables of the main figures, for the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

# Returns the cells of a row from a method's figure groups for a drive; an empty list if it has no such figures.
RowCells = Callable[[Mapping[str, Any]], list[float | None]]

_LATERAL = ("10 m", "ratio", "30 m", "ratio", "straight ratio")
_BENCHMARKS = ("TuSimple Acc", "FP", "FN", "F1 at IoU 0.5")
_CANDIDATES = ("base rate", "P", "R", "Acc", "AP")
_DECISIONS = (*_CANDIDATES, "ego prop.", "all prop.")
_BOUNDARIES = ("ego P", "ego R", "ego F1", "px", "all P", "all R", "all F1")


def figure_tables(figures: Mapping[str, Any]) -> Iterator[Table]:
    """Yields the tables of each level, with a section per drive and a row per method."""
    images, clips = figures["images"], figures["clips"]
    yield _table("A. Candidates, by the classifier's probability: false beyond 40 px", _CANDIDATES, images, _candidates)
    yield _table("A. Candidates, by the detector's decision, and proposal recall with 16", _DECISIONS, images, _decided)
    yield _table("B. Single images: boundaries, error in px at 640 wide", _BOUNDARIES, images, _on_images)
    if any(clips.values()):
        yield _table("B. Clips with the tracker", _BOUNDARIES, clips, lambda groups: _boundaries(groups["tracked"]))
        yield _table("B. Clips frame by frame", _BOUNDARIES, clips, lambda groups: _boundaries(groups["alone"]))
    yield _table(
        "Lateral error of the ego pair, px at 640 wide, and ratio to a constant prediction", _LATERAL, images, _lateral
    )
    yield _table("C. Benchmark metrics", _BENCHMARKS, images, lambda groups: _field(groups["field"]))
    yield _table(
        "C. Benchmark metrics of the ego pair only", _BENCHMARKS, images, lambda groups: _field(groups["field"]["ego"])
    )


def _candidates(groups: Mapping[str, Any]) -> list[float | None]:
    if "candidates" not in groups:
        return []
    return _shares(groups["candidates"]["far_40"])


def _decided(groups: Mapping[str, Any]) -> list[float | None]:
    if "candidates" not in groups:
        return []
    part, proposed = groups["candidates"]["decided"]["far_40"], groups["candidates"]["proposal_recall"]
    return [*_shares(part), *(proposed[which]["recall_16"] for which in ("ego", "all"))]


def _shares(part: Mapping[str, Any]) -> list[float | None]:
    return [part[key] for key in ("base_rate", "precision", "recall", "accuracy", "average_precision")]


def _on_images(groups: Mapping[str, Any]) -> list[float | None]:
    return _boundaries(groups["boundaries"])


def _boundaries(part: Mapping[str, Any]) -> list[float | None]:
    pair = [part["ego"][key] for key in ("precision", "recall", "f1", "mean_error_px_640")]
    return [*pair, *(part["all"][key] for key in ("precision", "recall", "f1"))]


def _lateral(groups: Mapping[str, Any]) -> list[float | None]:
    near, far = groups["lateral"]["10m"], groups["lateral"]["30m"]
    return [near["mean_px_640"], near["ratio"], far["mean_px_640"], far["ratio"], far["straight_ratio"]]


def _field(part: Mapping[str, Any]) -> list[float | None]:
    tusimple, culane = part["tusimple"], part["culane"]
    return [tusimple["accuracy"], tusimple["fp"], tusimple["fn"], culane["f1"]]


def _table(title: str, columns: Sequence[str], methods: Mapping[str, Any], cells: RowCells) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("")
    for column in columns:
        table.add_column(column, justify="right")
    for drive in next(iter(methods.values())):
        rows = [(method, cells(drives[drive])) for method, drives in methods.items()]
        if any(row for _, row in rows):
            table.add_row(Text(drive, style="bold"))
        for method, row in rows:
            if row:
                table.add_row(Text(f" {method}"), *map(_share, row))
    return table


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
