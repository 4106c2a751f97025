"""The tables of docs/benchmarks.md, from the file that `make bench` wrote."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import click

# What each headline figure is, by its key.
HEADLINES: Final = {
    "service_over_inprocess": "throughput over the pipeline in process, 4 sessions",
    "at_64_over_at_4": "throughput at 64 sessions over that at 4",
    "over_naive": "throughput over the naive service, 4 sessions",
    "over_litserve": "throughput over LitServe, 4 sessions",
    "median_ms_720p_classifier": "median from frame to reply, classifier, ms",
    "median_ms_720p_regressor": "median from frame to reply, regressor, ms",
    "overload_p95_age_over_median": "p95 frame age under 3 times the load over the unloaded median",
    "generator_cpu_share": "load generators' share of the processors, at most",
}
_HEAD: Final = ("", "frames", "sessions", "in flight", "frames/s", "p50 ms", "p95", "p99", "CPU ms/frame", "MB")


@click.command()
@click.argument("path", type=click.Path(path_type=Path), default=Path("out/bench.json"))
def main(path: Path) -> None:
    """Print the tables of docs/benchmarks.md as Markdown, from PATH."""
    try:
        lines = list(markdown(json.loads(path.read_text(encoding="utf-8"))))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise click.ClickException(f"{path} is not what `make bench` writes: {error}") from error
    for line in lines:
        click.echo(line)


def markdown(told: Mapping[str, Any]) -> Iterator[str]:
    """The lines of both tables, and of where they come from."""
    machine, versions = told["machine"], told["versions"]
    yield (
        f"{machine['processors']} processors ({machine['processor']}), provider {told['provider']}, {told['model']},"
        f" {told['candidates_per_frame']:g} candidates a frame, {told['frames']}, {told['rounds']} rounds,"
        f" PyTorch {versions['torch']}, LitServe {versions['litserve']}."
    )
    yield ""
    yield from _rows(("1280 x 720", "median", "least to most"), (_headline(told, key) for key in HEADLINES))
    yield ""
    yield from _rows(_HEAD, (_cell(cell) for cell in told["cells"]))


def _headline(told: Mapping[str, Any], key: str) -> tuple[str, ...]:
    spread = told["ratios"]["1280x720"].get(key)
    between = "" if spread is None else f"{_number(spread['least'], 2)} to {_number(spread['most'], 2)}"
    return HEADLINES[key], _number(told.get(key), 2), between


def _cell(cell: Mapping[str, Any]) -> tuple[str, ...]:
    name = cell["contestant"] + (", regressor" if cell["detector"] == "regression" else "")
    counts = (cell["size"].replace("x", " x "), str(cell["sessions"]), str(cell["in_flight"]))
    times = (_number(cell[key]) for key in ("p50_ms", "p95_ms", "p99_ms", "cpu_ms_per_frame"))
    return (name, *counts, _number(cell["fps"]["median"]), *times, f"{cell['memory_mb']:.0f}")


def _number(value: float | None, decimals: int = 1) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"


def _rows(head: tuple[str, ...], rows: Iterator[tuple[str, ...]]) -> Iterator[str]:
    for row in (head, ("---",) * len(head), *rows):
        yield "| " + " | ".join(row) + " |"


if __name__ == "__main__":
    main()
