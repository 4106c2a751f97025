"""Verdicts: the figures that matter in short sentences, and warnings of precisions that say little."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

# If more than this share of what is judged is a boundary, precision hardly measures false reports.
HIGH_BASE_RATE: Final = 0.9

# The probability from which a report counts as certain.
CERTAIN: Final = 0.9

Groups = Mapping[str, Any]


def verdicts(figures: Groups) -> list[str]:
    """Returns the lines on top of an evaluation: each method, each data set, clips, no roads, and warnings.

    `figures` are those of the JSON file. Data sets, clips and no roads are those of the first method.
    """
    first = next(iter(figures["methods"]))
    lines = [f"{name}: {_boundaries(drives['overall']['boundaries'])}" for name, drives in figures["images"].items()]
    lines += _kinds(figures["images"][first]["overall"]["kinds"])
    lines += [f"{name}: {_part(part)}" for name, part in figures["datasets"][first].items()]
    clips = figures["clips"][first]
    if clips:
        whole = clips["overall"]
        lines.append(f"clips with the tracker: {_boundaries(whole['tracked'])}{_looks(whole['kinds']['tracked'])}")
    lines += _no_road(figures["no_road"][first])
    lines += _towns(figures["towns"].get(first, {}))
    lines += _stills(figures["stills"].get(first, {}))
    lines += _reliability(figures["images"][first]["overall"]["reliability"], "single images")
    return [*lines, *_warnings(figures["images"][first]["overall"], figures["datasets"][first])]


def says_little(base_rate: float | None) -> bool:
    """Whether a precision at this base rate says little."""
    return base_rate is not None and base_rate > HIGH_BASE_RATE


def _boundaries(part: Groups) -> str:
    ego, every = part["ego"], part["all"]
    error = "" if ego["mean_error_px_640"] is None else f", {ego['mean_error_px_640']:.1f} px off at 640 wide"
    found = f"ego boundaries: {_found(ego)}, {ego['wrong']} wrong{error}"
    return f"{found}; all boundaries: {_found(every)}, {every['wrong']} wrong"


def _found(part: Groups) -> str:
    return f"{part['right']} of {part['right'] + part['missed']} right"


def _part(groups: Groups) -> str:
    """Returns the line of a data set."""
    boundaries, kinds = groups["boundaries"], groups["kinds"]
    ego = boundaries["ego"]
    line = f"{ego['frames']} frames, {_boundaries(boundaries)}"
    unmarked = kinds["false_markings"]["unmarked"]
    if unmarked["frames"]:
        line += f"; a marking reported in {unmarked['with_marking']} of {unmarked['frames']} unmarked frames"
    return line + _looks(kinds)


def _looks(kinds: Groups) -> str:
    """Returns how many types and colors are right, as the end of a line; empty without any."""
    parts = [
        f"{name} right on {part['right']} of {part['markings']} markings"
        for name, part in (("type", kinds["types"]), ("color", kinds["colors"]))
        if _is_classified(part)
    ]
    return "".join(f"; {part}" for part in parts)


def _is_classified(part: Groups) -> bool:
    """Whether a type or color was reported for any marking whose label has one."""
    return any(number for row in part["confusion"].values() for name, number in row.items() if name != "unknown")


def _kinds(kinds: Groups) -> Iterator[str]:
    unmarked, unpainted = kinds["false_markings"]["unmarked"], kinds["false_markings"]["unpainted"]
    if unmarked["frames"]:
        line = f"unmarked roads: a marking reported in {unmarked['with_marking']} of {unmarked['frames']} frames"
        if unpainted["frames"]:
            line += f", {unpainted['with_marking']} of {unpainted['frames']} where nothing at all is painted"
        yield line
    edges = kinds["road_edges"]
    if edges["labeled"]:
        yield (
            f"road edges: {edges['right']} of {edges['labeled']} reported as such, and {edges['wrong']} reports of an "
            "edge wrong"
        )
    for name in ("types", "colors"):
        part = kinds[name]
        if part["markings"] and not _is_classified(part):
            yield f"{name} of markings: not classified"
        elif part["markings"]:
            yield (
                f"{name} of markings, single images: {part['right']} of {part['markings']} right; always the most "
                f"frequent one: {round(part['constant_share'] * part['markings'])}"
            )


def _no_road(kinds: Groups) -> Iterator[str]:
    if kinds:
        part = kinds["overall"]
        yield (
            f"pictures without a road: a boundary reported in {part['with_boundary']} of {part['pictures']}, a marking "
            f"in {part['with_marking']}, both ego boundaries in {part['with_ego_lane']}"
        )


def _towns(part: Groups) -> Iterator[str]:
    if part:
        yield f"rendered towns: {_boundaries(part['boundaries'])}"
        yield from _reliability(part["reliability"], "rendered towns")


def _stills(sources: Groups) -> Iterator[str]:
    if sources:
        part = sources["overall"]
        yield (
            f"stills: a stream of one picture loses a boundary in {part['with_loss']} of {part['stills']}, "
            f"{part['lost']} of {part['boundaries']} boundaries"
        )


def _reliability(roles: Groups, where: str) -> Iterator[str]:
    """Yields how much of what is reported with a probability of at least 0.9 is right."""
    parts = []
    for role, part in roles.items():
        row = next(row for row in part["trade"] if row["least"] == CERTAIN)
        if row["precision"] is not None:
            reported = row["right"] + row["wrong"]
            parts.append(f"{row['right']} of {reported} {role} boundaries right ({_percent(row['precision'])})")
    if parts:
        yield f"{where}, what is reported with a probability of at least {CERTAIN}: {', '.join(parts)}"


def _warnings(overall: Groups, datasets: Groups) -> Iterator[str]:
    """Yields a warning for the data sets with a high base rate of ego sides, and one for that of candidates."""
    rates = {name: groups["boundaries"]["ego"]["base_rate"] for name, groups in datasets.items()}
    high = [f"{name} {_percent(rate)}" for name, rate in rates.items() if says_little(rate)]
    if high:
        sides = ", ".join(high)
        yield f"warning: ego precision says little where almost every judged side has a boundary: base rate {sides}"
    rate = overall["candidates"]["far_40"]["base_rate"] if "candidates" in overall else None
    if rate is not None and says_little(rate):
        yield f"warning: the precision of candidates says little, because {_percent(rate)} of them are boundaries"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"
