"""The option --label of commands that read labels, which says what the labels of a drawing program mean."""

from __future__ import annotations

from typing import Final

import click

from lanestream_exporter.choices import LABEL_MEANINGS

# Its values are for `LabelMap.of`.
LABEL_MAP: Final = click.option(
    "--label", "labels", multiple=True, metavar=f"LABEL={'|'.join(LABEL_MEANINGS)}",
    help="What a label of CVAT, LabelMe or Label Studio means; may be repeated.  [default: by its words]",
)  # fmt: skip
