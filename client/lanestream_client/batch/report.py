"""The progress of a batch, and its summary: a table on the screen, and summary.json."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from lanestream.writing import writing
from lanestream_client.batch.state import Counts

if TYPE_CHECKING:
    from lanestream_client.batch.state import UnitResult

_SUMMARY: Final = "summary.json"
# More are only in summary.json.
_MOST_LISTED: Final = 20
# The time that is left follows from the speed in the last minutes.
_ESTIMATE_S: Final = 300.0
_RUNS: Final = MappingProxyType({"this_run": "this run", "all_runs": "all runs"})
# How the table shows the figures.
_ROWS: Final = MappingProxyType(
    {
        "files": ("files", "{:,}"),
        "failed_files": ("failed files", "{:,}"),
        "frames": ("frames", "{:,}"),
        "damaged_frames": ("damaged frames", "{:,}"),
        "hours_of_video": ("hours of video", "{:.2f}"),
        "boundaries": ("boundaries in all frames", "{:,}"),
        "share_with_both_ego_boundaries": ("frames with both ego boundaries", "{:.1%}"),
        "frames_per_s": ("frames/s", "{:,.1f}"),
    }
)


class BatchReport:
    """Counts the outcomes of a run, which begins when it is created, and shows its progress on standard error.

    `total_bytes` is the size of all files of the run. The time that is left follows from the bytes per second.
    """

    def __init__(self, total_bytes: int, total_files: int) -> None:
        self._started = time.monotonic()
        self._total_files = total_files
        self._finished_bytes = 0.0
        self._unfinished_frames = 0
        self.counts = Counts()
        self.done = 0
        self.failed = 0
        console = Console(stderr=True)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:.1f} %"),
            TimeRemainingColumn(),
        )
        self._bar = Progress(
            *columns,
            speed_estimate_period=_ESTIMATE_S,
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        self._task = self._bar.add_task(self._status, total=max(total_bytes, 1))

    @property
    def seconds(self) -> float:
        """The time since the start."""
        return time.monotonic() - self._started

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Shows the progress during the block, if standard error is a terminal."""
        with self._bar:
            yield

    def show(self, unfinished_bytes: float, unfinished_frames: int) -> None:
        """Shows the progress, including what is done of the units that are not finished."""
        self._unfinished_frames = unfinished_frames
        self._bar.update(self._task, completed=self._finished_bytes + unfinished_bytes, description=self._status)

    def add(self, result: UnitResult) -> None:
        """Counts the outcome of a unit, and prints its notes."""
        self.counts += result.counts
        self.failed += len(result.failed)
        self.done += len(result.unit.files) - len(result.failed)
        self._finished_bytes += result.unit.size
        for note in result.notes:
            click.echo(f"warning: {note}", err=True)

    def summary(self, total: Counts, done: int, failed: int) -> dict[str, Any]:
        """Returns the figures of this run and of all runs, from those of all runs: counts, files, failed files."""
        run = _figures(self.counts, self.done, self.failed)
        run |= {"seconds": round(self.seconds, 1), "frames_per_s": round(self._rate, 1)}
        return {"this_run": run, "all_runs": _figures(total, done, failed)}

    @property
    def _rate(self) -> float:
        return self.counts.frames / max(self.seconds, 1e-9)

    @property
    def _status(self) -> str:
        failed = f", {self.failed} failed" if self.failed else ""
        rate = (self.counts.frames + self._unfinished_frames) / max(self.seconds, 1e-9)
        return f"{self.done} of {self._total_files} files{failed}, {rate:.0f} frames/s"


def print_summary(figures: Mapping[str, Mapping[str, Any]], failed: Mapping[str, str], title: str) -> None:
    """Prints the figures of `BatchReport.summary` as a table, and the files that failed."""
    table = Table("", *_RUNS.values(), box=None)
    for column in table.columns[1:]:
        column.justify = "right"
    for name, (label, form) in _ROWS.items():
        values = (figures[run].get(name) for run in _RUNS)
        table.add_row(label, *("" if value is None else form.format(value) for value in values))
    Console().print(table)
    click.echo(title)
    for path, error in list(failed.items())[:_MOST_LISTED]:
        click.echo(f"failed: {path}: {error}")
    if len(failed) > _MOST_LISTED:
        click.echo(f"... and {len(failed) - _MOST_LISTED} more failed, see {_SUMMARY}")


def write_summary(out: Path, content: Mapping[str, Any]) -> None:
    """Writes summary.json. Raises WriteError."""
    part = out / f".{_SUMMARY}.part"
    with writing(out / _SUMMARY):
        part.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        part.replace(out / _SUMMARY)


def _figures(counts: Counts, done: int, failed: int) -> dict[str, Any]:
    answered = counts.frames - counts.failed_frames
    return {
        "files": done,
        "failed_files": failed,
        "frames": counts.frames,
        "damaged_frames": counts.lost_frames + counts.failed_frames,
        "hours_of_video": round(counts.video_s / 3600.0, 4),
        "boundaries": counts.boundaries,
        "share_with_both_ego_boundaries": round(counts.both_ego / answered, 4) if answered else None,
    }
