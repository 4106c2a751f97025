"""The command `data check`: is a data set sound, before a network learns from it?"""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TextColumn

from lanestream.errors import LabelError
from lanestream_exporter.datasets.checking import Check
from lanestream_exporter.datasets.contact_sheet import ContactSheet
from lanestream_exporter.datasets.folder import DataFolder
from lanestream_exporter.datasets.formats import FORMATS
from lanestream_exporter.datasets.reading import form_of, survey

_FORM = click.option("--format", "form", type=click.Choice(["auto", *FORMATS]), default="auto", show_default=True)


@click.group()
def data() -> None:
    """Look after labelled frames."""


@data.command()
@click.argument("path", type=click.Path(path_type=Path))
@_FORM
@click.option("--sheet", type=click.Path(path_type=Path, dir_okay=False), help="Draw up to 60 frames with their lanes.")
@click.option(
    "--against", type=click.Path(path_type=Path), help="The other side of a split: what both hold is named as a leak."
)
def check(path: Path, form: str, sheet: Path | None, against: Path | None) -> None:
    """Say what the data set at PATH holds, and name every record that is wrong.

    PATH is a folder or a label file: TuSimple, CULane, Caltech, LabelMe, CVAT, mask images or clip labels. Ends with
    exit code 1 where anything is wrong.
    """
    pictures = ContactSheet(sheet) if sheet is not None else None
    checked = _checked(path, form, pictures)
    faults = checked.faults
    if against is not None:
        other = _checked(against, "auto", None)
        faults = [*faults, *other.faults, *checked.leaks(other)]
    for fault in faults:
        click.echo(f"bad: {fault}")
    if pictures is not None and len(pictures):
        pictures.write()
        click.echo(f"{sheet}: {len(pictures)} frames")
    if faults:
        raise LabelError(
            f"{len(faults)} faults in {path}" if len(faults) > 1 else f"one fault in {path}", "named above"
        )


def _checked(path: Path, form: str, sheet: ContactSheet | None) -> Check:
    """Reads a data set through and prints what it holds."""
    name = form_of(DataFolder.at(path), form)
    checked = Check()
    console = Console(stderr=True)
    columns = TextColumn("frames"), MofNCompleteColumn()
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task("frames", total=None)
        for found in survey(path, name):
            checked.add(found)
            if sheet is not None and not isinstance(found, LabelError):
                sheet.add(found.frame, found.image)
            bar.advance(task)
    click.echo(f"{path}: {name}")
    for line in checked.contents.lines():
        click.echo(f"  {line}")
    if len(checked.contents.groups) == 1:
        click.echo("  one group: a split into training and validation needs two drives or clips at least")
    return checked
