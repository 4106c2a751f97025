"""The names that options accept are those of the tables."""

from __future__ import annotations

from typing import get_args

from lanestream_exporter import choices
from lanestream_exporter.datasets.formats import AUTO, FORMATS
from lanestream_exporter.datasets.label_map import MEANINGS
from lanestream_exporter.exporting.exportable import Precision
from lanestream_exporter.exporting.graph import NORMALIZATIONS
from lanestream_exporter.labeling.writers import WRITERS
from lanestream_exporter.scenes.scene import STYLES
from lanestream_exporter.scenes.tracking_clips import KINDS


def test_options_accept_what_the_tables_have() -> None:
    assert tuple(STYLES) == choices.ROAD_STYLES
    assert tuple(KINDS) == choices.CLIP_KINDS
    assert (AUTO, *FORMATS) == choices.LABEL_FORMATS
    assert tuple(WRITERS) == choices.PRELABEL_FORMATS
    assert MEANINGS == choices.LABEL_MEANINGS
    assert get_args(Precision) == choices.PRECISIONS
    assert tuple(NORMALIZATIONS) == choices.NORMALIZATIONS
