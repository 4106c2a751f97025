"""The command `data check`, which checks a data set before a network learns from it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TextColumn

from lanestream.errors import LabelError
from lanestream_exporter.choices import LABEL_FORMATS

if TYPE_CHECKING:
    from lanestream_exporter.datasets.checking import DatasetCheck
    from lanestream_exporter.datasets.contact_sheet import ContactSheet

_FORMAT = click.option(
    "--format", "format_name", type=click.Choice(LABEL_FORMATS), default="auto", show_default=True,
    help="The format of the labels.",
)  # fmt: skip


@click.group()
def data() -> None:
    """Check labeled frames."""


@data.command()
@click.argument("path", type=click.Path(path_type=Path))
@_FORMAT
@click.option("--sheet", type=click.Path(path_type=Path, dir_okay=False), help="Draw up to 60 frames with their lanes.")
@click.option(
    "--against",
    type=click.Path(path_type=Path),
    help="The other side of a split: report what both share as leaks.",
)
def check(path: Path, format_name: str, sheet: Path | None, against: Path | None) -> None:
    """Summarize the data set at PATH and report every faulty record.

    PATH is a folder or a label file: TuSimple, CULane, Caltech, LabelMe, CVAT, mask images or clip labels. The exit
    code is 1 if anything is wrong.
    """
    from lanestream_exporter.datasets.contact_sheet import ContactSheet

    contact_sheet = ContactSheet(sheet) if sheet is not None else None
    checked = _check_and_print(path, format_name, contact_sheet)
    faults = checked.faults
    if against is not None:
        other = _check_and_print(against, "auto", None)
        faults = [*faults, *other.faults, *checked.leaks(other)]
    for fault in faults:
        click.echo(f"bad: {fault}")
    if contact_sheet is not None and len(contact_sheet):
        contact_sheet.write()
        click.echo(f"{sheet}: {len(contact_sheet)} frames")
    if faults:
        raise LabelError(f"{len(faults)} fault{'s' if len(faults) > 1 else ''} in {path}", "listed above")


def _check_and_print(path: Path, format_name: str, sheet: ContactSheet | None) -> DatasetCheck:
    """Reads a whole data set and prints what it holds."""
    from lanestream_exporter.datasets.checking import DatasetCheck
    from lanestream_exporter.datasets.files import DataFolder
    from lanestream_exporter.datasets.formats import format_of
    from lanestream_exporter.datasets.reading import scan_dataset

    name = format_of(DataFolder.at(path), format_name)
    checked = DatasetCheck()
    console = Console(stderr=True)
    columns = TextColumn("frames"), MofNCompleteColumn()
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task("frames", total=None)
        for found in scan_dataset(path, name):
            checked.add(found)
            if sheet is not None and not isinstance(found, LabelError):
                sheet.add(found.frame, found.image)
            bar.advance(task)
    click.echo(f"{path}: {name}")
    for line in checked.contents.lines():
        click.echo(f"  {line}")
    if len(checked.contents.groups) == 1:
        click.echo("  one group: a split by group needs at least two drives or clips")
    return checked
