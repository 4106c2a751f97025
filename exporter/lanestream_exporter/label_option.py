"""The option --label of commands that read labels, which says what the labels of a drawing program mean."""

from __future__ import annotations

from typing import Any, Final

import click

from lanestream_exporter.datasets.label_map import MEANINGS, LabelMap


def _label_map(_context: click.Context, _option: click.Parameter, pairs: Any) -> LabelMap:
    return LabelMap.of(pairs)


LABEL_MAP: Final = click.option(
    "--label", "labels", multiple=True, callback=_label_map, metavar=f"LABEL={'|'.join(MEANINGS)}",
    help="What a label of CVAT, LabelMe or Label Studio means; may be repeated.  [default: by its words]",
)  # fmt: skip
