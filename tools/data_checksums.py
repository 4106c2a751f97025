"""Writes what `lanestream data fetch` compares a user's data with: configs/data/checksums.toml.

python tools/data_checksums.py ../shared/data
"""

from __future__ import annotations

import json
from pathlib import Path

import click

from lanestream_exporter.datasets.public_data import CHECKSUMS, checksums_of, public_sources


@click.command(help=__doc__)
@click.argument("data", type=click.Path(path_type=Path, exists=True, file_okay=False))
def main(data: Path) -> None:
    """Writes the sizes and hashes of the files in the folder DATA."""
    try:
        content = checksums_of(public_sources(), data)
    except OSError as error:
        raise click.ClickException(f"can't read {error.filename}: {(error.strerror or str(error)).lower()}") from error
    lines = ["# Written by tools/data_checksums.py"]
    for kind, sums in content.items():
        for each in sums:
            lines += ["", f"[[{kind}]]", *(f"{key} = {json.dumps(value)}" for key, value in each.items())]
    CHECKSUMS.write_text("\n".join(lines) + "\n", encoding="utf-8")
    click.echo(f"{CHECKSUMS}: {', '.join(f'{len(sums)} {kind}s' for kind, sums in content.items())}")


if __name__ == "__main__":
    main()
