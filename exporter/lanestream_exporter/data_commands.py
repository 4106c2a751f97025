"""The commands `data check`, before a network learns from a data set, and `data fetch`, for the public data sets."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

from lanestream.errors import LabelError
from lanestream_exporter.choices import LABEL_FORMATS
from lanestream_exporter.label_option import LABEL_MAP

if TYPE_CHECKING:
    from lanestream_exporter.datasets.checking import DatasetCheck
    from lanestream_exporter.datasets.contact_sheet import ContactSheet
    from lanestream_exporter.datasets.label_map import LabelMap
    from lanestream_exporter.datasets.public_data import SourceStatus

_FORMAT = click.option(
    "--format", "format_name", type=click.Choice(LABEL_FORMATS), default="auto", show_default=True,
    help="The format of the labels.",
)  # fmt: skip


@click.group()
def data() -> None:
    """Check labeled frames, and find public ones."""


@data.command()
@click.argument("path", type=click.Path(path_type=Path))
@_FORMAT
@LABEL_MAP
@click.option("--sheet", type=click.Path(path_type=Path, dir_okay=False), help="Draw up to 60 frames with their lanes.")
@click.option(
    "--against",
    type=click.Path(path_type=Path),
    help="The other side of a split: report what both share as leaks.",
)
def check(path: Path, format_name: str, labels: tuple[str, ...], sheet: Path | None, against: Path | None) -> None:
    """Summarize the data set at PATH and report every faulty record.

    PATH is a folder or a label file: TuSimple, CULane, Caltech, LabelMe, CVAT, Label Studio, mask images or clip
    labels. The exit code is 1 if anything is wrong.
    """
    from lanestream_exporter.datasets.contact_sheet import ContactSheet
    from lanestream_exporter.datasets.label_map import LabelMap

    label_map = LabelMap.of(labels)
    contact_sheet = ContactSheet(sheet) if sheet is not None else None
    checked = _check_and_print(path, format_name, label_map, contact_sheet)
    faults = checked.faults
    if against is not None:
        other = _check_and_print(against, "auto", label_map, None)
        faults = [*faults, *other.faults, *checked.leaks(other)]
    for fault in faults:
        click.echo(f"bad: {fault}")
    if contact_sheet is not None and len(contact_sheet):
        contact_sheet.write()
        click.echo(f"{sheet}: {len(contact_sheet)} frames")
    if faults:
        raise LabelError(f"{len(faults)} fault{'s' if len(faults) > 1 else ''} in {path}", "listed above")


@data.command()
@click.argument("name", required=False)
@click.option(
    "--data", "folder", type=click.Path(path_type=Path), help="Folder of the data sets.  [default: $LANESTREAM_DATA]"
)
def fetch(name: str | None, folder: Path | None) -> None:
    """Show where the public data sets of the shipped networks come from, and check your copy of them.

    Nothing is downloaded. NAME is one of the data sets, by default all. The exit code is 1 if one is missing, or if its
    files are not those that the shipped networks were trained and measured with.
    """
    from lanestream_exporter.datasets.manifest import SHIPPED_DATA, data_folder
    from lanestream_exporter.datasets.public_data import check_sources, public_sources

    root = data_folder(folder)
    found = list(check_sources(public_sources(name), root))
    table = Table("name", "data set", "license", "state")
    for status in found:
        table.add_row(status.source.folder, status.source.title, status.source.license, status.state)
    Console(highlight=False).print(table)
    incomplete = [status for status in found if status.state != "present"]
    for status in incomplete if name is None else found:
        shown = f"$LANESTREAM_DATA/{status.source.folder}" if root == SHIPPED_DATA else root / status.source.folder
        _print_source(status, shown)
    if incomplete:
        named = "" if root == SHIPPED_DATA else f" in {root}"
        counts = Counter(status.state for status in incomplete)
        raise LabelError(
            f"{', '.join(f'{count} {state}' for state, count in counts.items())}{named}",
            "name the folder of the data sets with --data or LANESTREAM_DATA",
        )


def _print_source(status: SourceStatus, folder: Path | str) -> None:
    source = status.source
    click.echo(f"\n{source.folder}: {status.state}")
    click.echo(f"  page: {source.page}{f' at {source.commit}' if source.commit else ''}")
    click.echo(f"  license: {source.license}")
    click.echo(f"  download: {source.download}")
    click.echo(f"  prepare: {source.prepare}")
    click.echo(f"  put it into: {folder}")
    for problem in status.problems:
        click.echo(f"  {problem}")


def _check_and_print(path: Path, format_name: str, labels: LabelMap, sheet: ContactSheet | None) -> DatasetCheck:
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
        for found in scan_dataset(path, name, labels):
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
