"""Prints the tables of the model card, from the file that `lanestream evaluate --json` wrote."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import click

Groups = Mapping[str, Any]


@click.command()
@click.argument("path", type=click.Path(path_type=Path), default=Path("out/evaluation.json"))
def main(path: Path) -> None:
    """Print every table of the model card as Markdown, from PATH."""
    try:
        evaluation = json.loads(path.read_text(encoding="utf-8"))
        images, clips = evaluation["images"], evaluation["clips"]
        datasets, conditions = evaluation["datasets"], evaluation["conditions"]
        towns = {method: {"rendered towns": part} for method, part in evaluation["towns"].items() if part}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise click.ClickException(f"{path} was not written by `lanestream evaluate --json`: {error}") from error
    click.echo("\n".join(f"- {line}" for line in evaluation["verdicts"]))
    for title, head, rows in (
        ("Boundaries by data set", _BOUNDARIES, _rows(datasets, lambda groups: _boundaries(groups["boundaries"]))),
        ("Kinds by data set", _KINDS, _rows(datasets, lambda groups: _kinds(groups["kinds"]))),
        ("Boundaries by condition", _BOUNDARIES, _rows(conditions, lambda groups: _boundaries(groups["boundaries"]))),
        ("Kinds by condition", _KINDS, _rows(conditions, lambda groups: _kinds(groups["kinds"]))),
        ("Kinds, clips with the tracker", _KINDS, _rows(clips, lambda groups: _kinds(groups["kinds"]["tracked"]))),
        ("A. Candidates by the classifier", _CANDIDATES, _rows(images, _candidates)),
        ("A. Candidates by the detector", _CANDIDATES, _rows(images, _detected)),
        ("Proposal recall", _PROPOSAL_RECALL, _rows(images, _proposal_recall)),
        ("B. Single images", _BOUNDARIES, _rows(images, lambda groups: _boundaries(groups["boundaries"]))),
        ("Rendered towns", _BOUNDARIES, _rows(towns, lambda groups: _boundaries(groups["boundaries"]))),
        ("Reliability, single images", _TRADE, _trade(images, "overall")),
        ("Reliability, rendered towns", _TRADE, _trade(towns, "rendered towns")),
        ("B. With the tracker", _BOUNDARIES, _rows(clips, lambda groups: _boundaries(groups["tracked"]))),
        (
            "B. Without the tracker",
            _BOUNDARIES,
            _rows(clips, lambda groups: _boundaries(groups["alone"])),
        ),
        ("Steadiness", _STEADINESS, _rows(clips, _steady)),
        ("Lateral error", _LATERAL, _rows(images, _lateral)),
        ("C. Benchmark metrics", _METRICS, _rows(images, lambda groups: _metrics(groups["field"]))),
        (
            "C. Benchmark metrics of the ego pair only",
            _METRICS,
            _rows(images, lambda groups: _metrics(groups["field"]["ego"])),
        ),
    ):
        click.echo(f"\n**{title}**\n")
        for row in (("", *head), ["---"] * (len(head) + 1), *rows):
            click.echo("| " + " | ".join(row) + " |")


_CANDIDATES = ("precision", "recall", "accuracy", "average precision", "base rate", "unsure, unknown")
_PROPOSAL_RECALL = ("ego, 8", "ego, 16", "ego, 32", "all, 8", "all, 16", "all, 32")
_BOUNDARIES = ("ego base rate", "ego precision", "ego recall", "ego error, px", "all precision", "all recall")
_KINDS = ("frames with a false marking", "edge precision", "edge recall", "type right", "color right")
_TRADE = ("ego precision", "ego recall", "outer precision", "outer recall")
_STEADINESS = ("both ego boundaries", "jitter, px", "identity switches")
_LATERAL = ("10 m, px", "ratio to constant", "30 m, px", "ratio to constant", "reached 30 m", "ratio, straight")
_METRICS = ("TuSimple Acc", "FP", "FN", "F1 at IoU 0.5")


def _rows(methods: Mapping[str, Any], cells: Any) -> Iterable[list[str]]:
    """Yields a row for each drive and method that has such numbers."""
    for drive in next(iter(methods.values()), {}):
        for method, drives in methods.items():
            row = cells(drives[drive])
            if row:
                yield [f"{drive}, {method}", *row]


def _candidates(groups: Groups) -> list[str]:
    if "candidates" not in groups:
        return []
    return _confusion(groups["candidates"]["far_40"])


def _detected(groups: Groups) -> list[str]:
    return _confusion(groups["candidates"]["decided"]["far_40"]) if "candidates" in groups else []


def _confusion(part: Groups) -> list[str]:
    tp, fp, fn, tn = (part["confusion"][key] for key in ("tp", "fp", "fn", "tn"))
    return [
        _counted(part, "precision", tp, tp + fp),
        _counted(part, "recall", tp, tp + fn),
        _counted(part, "accuracy", tp + tn, tp + fp + fn + tn),
        _share(part["average_precision"]),
        _share(part["base_rate"]),
        f"{part['unsure']}, {part['unknown']}",
    ]


def _proposal_recall(groups: Groups) -> list[str]:
    if "candidates" not in groups:
        return []
    parts = [groups["candidates"]["proposal_recall"][which] for which in ("ego", "all")]
    return [
        f"{_share(part['recall'][number - 1])} ({part['found'][number - 1]} / {part['labels']})"
        for part in parts
        for number in (8, 16, 32)
    ]


def _trade(methods: Mapping[str, Any], drive: str) -> Iterable[list[str]]:
    """Yields a row for each probability from which boundaries count, of each method that reports probabilities."""
    for method, drives in methods.items():
        roles = drives[drive]["reliability"].values()
        for rows in zip(*(role["trade"] for role in roles), strict=True):
            cells = []
            for row, role in zip(rows, roles, strict=True):
                cells.append(f"{_share(row['precision'])} ({row['right']} / {row['right'] + row['wrong']})")
                cells.append(f"{_share(row['recall'])} ({row['found']} / {role['labels']})")
            yield [f"{method}, from {rows[0]['least']}", *cells]


def _boundaries(part: Groups) -> list[str]:
    cells = []
    for which in ("ego", "all"):
        group = part[which]
        right, wrong, missed = (group[key] for key in ("right", "wrong", "missed"))
        cells += [_share(group["base_rate"])] if which == "ego" else []
        cells += [_counted(group, "precision", right, right + wrong), _counted(group, "recall", right, right + missed)]
        if which == "ego":
            cells.append(_pixels(group["mean_error_px_640"]))
    return cells


def _kinds(part: Groups) -> list[str]:
    false, edges = part["false_markings"]["unmarked"], part["road_edges"]
    right, wrong, labeled = (edges[key] for key in ("right", "wrong", "labeled"))
    looks = (part["types"], part["colors"])
    if not any((false["frames"], edges["frames"], *(look["markings"] for look in looks))):
        return []
    return [
        _counted(false, "share", false["with_marking"], false["frames"]),
        _counted(edges, "precision", right, right + wrong),
        _counted(edges, "recall", right, labeled),
        *(f"{_share(look['right_share'])} ({look['right']} / {look['markings']})" for look in looks),
    ]


def _steady(groups: Groups) -> list[str]:
    if "steadiness" not in groups:
        return []
    steady = groups["steadiness"]
    switches = steady["id_switches"]
    return [
        f"{_share(steady['both_ego'])} ({steady['both_ego_frames']} / {steady['frames']})",
        _pixels(steady["jitter_px_640"]),
        "-" if switches is None else str(switches),
    ]


def _lateral(groups: Groups) -> list[str]:
    cells = []
    for distance in ("10m", "30m"):
        part = groups["lateral"][distance]
        cells += [
            f"{_pixels(part['mean_px_640'])} ({part['reported']} of {part['labeled']})",
            f"{_share(part['ratio'])}{_interval(part, 'ratio')}",
        ]
    far = groups["lateral"]["30m"]
    return [*cells, str(far["reached"]), f"{_share(far['straight_ratio'])}{_interval(far, 'straight_ratio')}"]


def _metrics(part: Groups) -> list[str]:
    tusimple, culane = part["tusimple"], part["culane"]
    return [
        f"{_share(tusimple['accuracy'])}{_interval(tusimple, 'accuracy')}",
        _share(tusimple["fp"]),
        _share(tusimple["fn"]),
        f"{_share(culane['f1'])} ({culane['tp']} right, {culane['fp']} wrong, {culane['fn']} missed)",
    ]


def _counted(group: Groups, key: str, part: int, whole: int) -> str:
    return f"{_share(group[key])} ({part} / {whole}){_interval(group, key)}"


def _interval(group: Groups, key: str) -> str:
    bounds = group["intervals"][key]
    return "" if bounds is None else f" [{bounds[0]:.2f}, {bounds[1]:.2f}]"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _pixels(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


if __name__ == "__main__":
    main()
