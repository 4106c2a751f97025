"""The table of label formats, and recognizing the format of a data set by its files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from lanestream.errors import LabelError
from lanestream_exporter.datasets.caltech import caltech_entries, is_caltech
from lanestream_exporter.datasets.clips import clip_entries, is_clip_labels
from lanestream_exporter.datasets.culane import culane_entries, is_culane
from lanestream_exporter.datasets.cvat import cvat_entries, is_cvat
from lanestream_exporter.datasets.entries import LabelFormat
from lanestream_exporter.datasets.files import DataFolder, start_of
from lanestream_exporter.datasets.labelme import is_labelme, labelme_entries
from lanestream_exporter.datasets.masks import is_mask, mask_entries
from lanestream_exporter.datasets.other_programs import refuse_other_programs
from lanestream_exporter.datasets.tusimple import is_tusimple, tusimple_entries

# A file belongs to the first format that recognizes it.
FORMATS: Final[Mapping[str, LabelFormat]] = {
    "tusimple": LabelFormat(tusimple_entries, is_tusimple),
    "culane": LabelFormat(culane_entries, is_culane),
    "caltech": LabelFormat(caltech_entries, is_caltech),
    "labelme": LabelFormat(labelme_entries, is_labelme),
    "cvat": LabelFormat(cvat_entries, is_cvat),
    "masks": LabelFormat(mask_entries, is_mask),
    "clips": LabelFormat(clip_entries, is_clip_labels),
}
AUTO: Final = "auto"

_TEXT_SUFFIXES: Final = (".json", ".jsonl", ".xml")
_MOST_TEXT_FILES: Final = 100  # read to recognize a data set


def format_of(folder: DataFolder, name: str = AUTO) -> str:
    """Returns the format to read `folder` in: `name`, or for "auto" the one that its files have.

    Raises LabelError if `name` is unknown, if no labels are found, or if the files have several formats.
    For labels of a program that is not read, the error names the program.
    """
    if name in FORMATS:
        return name
    if name != AUTO:
        raise LabelError(f"unknown label format {name!r}", f"{', '.join(FORMATS)} and {AUTO} are accepted")
    found = _formats_of_files(folder)
    if not found:
        refuse_other_programs(folder)
        raise LabelError(
            f"no labels of a known format in {folder.root}", f"{', '.join(FORMATS)} are read; name one with --format"
        )
    if len(found) > 1:
        raise LabelError(
            f"{folder.root} has labels of several formats: {', '.join(sorted(found))}", "name one with --format"
        )
    return found.pop()


def _formats_of_files(folder: DataFolder) -> set[str]:
    found = set()
    text_files = 0
    for path in folder.files:
        start = b""
        if path.suffix.lower() in _TEXT_SUFFIXES:
            text_files += 1
            start = start_of(path) if text_files <= _MOST_TEXT_FILES else b""
        found |= set(next(([name] for name, form in FORMATS.items() if form.recognizes(path, start)), []))
    return found
