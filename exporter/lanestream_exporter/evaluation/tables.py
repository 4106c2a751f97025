"""Tables of the main figures, for the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from lanestream_exporter.evaluation.verdicts import HIGH_BASE_RATE, says_little

# Returns the cells of a row from a method's figure groups for a drive; an empty list if it has no such figures.
RowCells = Callable[[Mapping[str, Any]], list[float | str | None]]

_LATERAL = ("10 m", "ratio", "30 m", "ratio", "straight ratio")
_BENCHMARKS = ("TuSimple Acc", "FP", "FN", "F1 at IoU 0.5")
_CANDIDATES = ("base rate", "P", "R", "Acc", "AP")
_DECISIONS = (*_CANDIDATES, "ego prop.", "all prop.")
_BOUNDARIES = ("frames", "right", "wrong", "missed", "ego base", "ego P", "ego R", "px", "all P", "all R", "all F1")
_KINDS = ("marked", "of", "edge P", "edge R", "type", "of", "constant", "color", "of", "constant")
_NO_ROAD = ("pictures", "boundary", "marking", "ego lane", "share")
_STILLS = ("stills", "with a loss", "boundaries", "lost", "gained")
_TRADE = ("right", "wrong", "precision", "found", "recall")
_KINDS_TITLE = "Frames without markings in which one is reported, edges of the road, types and colors"
_LITTLE = f"* says little: more than {HIGH_BASE_RATE:.0%} of what is judged are boundaries (base rate)"


def figure_tables(figures: Mapping[str, Any]) -> Iterator[Table]:
    """Yields the tables of each level, with a section per drive and a row per method."""
    images, clips, no_road = figures["images"], figures["clips"], figures["no_road"]
    for title, parts in (("data set", figures["datasets"]), ("condition", figures["conditions"])):
        if any(parts.values()):
            yield _table(f"Boundaries by {title}, single images", _BOUNDARIES, parts, _on_images)
            yield _table(f"{_KINDS_TITLE}, by {title}", _KINDS, parts, lambda groups: _kinds(groups["kinds"]))
    yield _table(f"{_KINDS_TITLE}, single images", _KINDS, images, lambda groups: _kinds(groups["kinds"]))
    if any(clips.values()):
        yield _table(f"{_KINDS_TITLE}, clips with the tracker", _KINDS, clips, _tracked_kinds)
    if any(no_road.values()):
        overall = {method: {"overall": kinds["overall"]} for method, kinds in no_road.items()}
        yield _table("Pictures without a road in which something is reported", _NO_ROAD, overall, _no_road)
    if any(figures["towns"].values()):
        towns = {method: {"all": part} for method, part in figures["towns"].items()}
        yield _table("Boundaries in rendered towns, single images", _BOUNDARIES, towns, _on_images)
    if any(figures["stills"].values()):
        stills = figures["stills"]
        yield _table("Boundaries that a stream of one picture loses", _STILLS, stills, _stills)
    yield from _trades(figures)
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


def _trades(figures: Mapping[str, Any]) -> Iterator[Table]:
    """Yields precision and recall from each probability on, of the first method, for the ego pair and outer ones."""
    first = next(iter(figures["images"]))
    parts = {"single images": figures["images"][first]["overall"], "rendered towns": figures["towns"].get(first)}
    for name, part in parts.items():
        roles = part["reliability"] if part else {}
        if roles:
            title = f"{first}: boundaries from a probability on, {name}"
            rows = {role: {str(row["least"]): row for row in of_role["trade"]} for role, of_role in roles.items()}
            by_least = {least: {role: rows[role][least] for role in rows} for least in rows["ego"]}
            table = _empty(title, [f"{role} {column}" for role in rows for column in _TRADE])
            for least, by_role in by_least.items():
                table.add_row(least, *(_cell(row[column]) for row in by_role.values() for column in _TRADE))
            yield table


def _tracked_kinds(groups: Mapping[str, Any]) -> list[float | str | None]:
    return _kinds(groups["kinds"]["tracked"])


def _kinds(kinds: Mapping[str, Any]) -> list[float | str | None]:
    unmarked, edges = kinds["false_markings"]["unmarked"], kinds["road_edges"]
    if not any((unmarked["frames"], edges["frames"], kinds["types"]["markings"], kinds["colors"]["markings"])):
        return []
    cells = [unmarked["with_marking"], unmarked["frames"], edges["precision"], edges["recall"]]
    for part in (kinds["types"], kinds["colors"]):
        cells += [part["right_share"], part["markings"], part["constant_share"]]
    return cells


def _no_road(part: Mapping[str, Any]) -> list[float | str | None]:
    return [part[key] for key in ("pictures", "with_boundary", "with_marking", "with_ego_lane", "share")]


def _stills(part: Mapping[str, Any]) -> list[float | str | None]:
    return [part[key] for key in ("stills", "with_loss", "boundaries", "lost", "gained")]


def _candidates(groups: Mapping[str, Any]) -> list[float | str | None]:
    if "candidates" not in groups:
        return []
    return _shares(groups["candidates"]["far_40"])


def _decided(groups: Mapping[str, Any]) -> list[float | str | None]:
    if "candidates" not in groups:
        return []
    part, proposed = groups["candidates"]["decided"]["far_40"], groups["candidates"]["proposal_recall"]
    return [*_shares(part), *(proposed[which]["recall_16"] for which in ("ego", "all"))]


def _shares(part: Mapping[str, Any]) -> list[float | str | None]:
    rest = (part[key] for key in ("recall", "accuracy", "average_precision"))
    return [part["base_rate"], _precision(part), *rest]


def _on_images(groups: Mapping[str, Any]) -> list[float | str | None]:
    return _boundaries(groups["boundaries"])


def _boundaries(part: Mapping[str, Any]) -> list[float | str | None]:
    ego = part["ego"]
    counts = [ego[key] for key in ("frames", "right", "wrong", "missed", "base_rate")]
    rates = [_precision(ego), ego["recall"], ego["mean_error_px_640"]]
    return [*counts, *rates, *(part["all"][key] for key in ("precision", "recall", "f1"))]


def _precision(part: Mapping[str, Any]) -> str:
    """Returns a precision, marked if its base rate makes it say little."""
    is_marked = part["precision"] is not None and says_little(part["base_rate"])
    return _cell(part["precision"]) + ("*" if is_marked else "")


def _lateral(groups: Mapping[str, Any]) -> list[float | str | None]:
    near, far = groups["lateral"]["10m"], groups["lateral"]["30m"]
    return [near["mean_px_640"], near["ratio"], far["mean_px_640"], far["ratio"], far["straight_ratio"]]


def _field(part: Mapping[str, Any]) -> list[float | str | None]:
    tusimple, culane = part["tusimple"], part["culane"]
    return [tusimple["accuracy"], tusimple["fp"], tusimple["fn"], culane["f1"]]


def _table(title: str, columns: Sequence[str], methods: Mapping[str, Any], cells: RowCells) -> Table:
    table = _empty(title, columns)
    for drive in next(iter(methods.values())):
        rows = [(method, cells(drives[drive])) for method, drives in methods.items()]
        if any(row for _, row in rows):
            table.add_row(Text(drive, style="bold"))
        for method, row in rows:
            if row:
                table.add_row(Text(f" {method}"), *map(_cell, row))
                if any(isinstance(cell, str) and cell.endswith("*") for cell in row):
                    table.caption = _LITTLE
    return table


def _empty(title: str, columns: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", caption_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("")
    for column in columns:
        table.add_column(column, justify="right")
    return table


def _cell(value: float | str | None) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
