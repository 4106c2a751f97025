"""The table of label formats, and recognizing the format of a data set by its files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from lanestream.errors import LabelError
from lanestream_exporter.datasets.caltech import caltech_entries, is_caltech
from lanestream_exporter.datasets.clips import clip_entries, is_clip_labels
from lanestream_exporter.datasets.culane import culane_entries, is_culane
from lanestream_exporter.datasets.cvat import cvat_entries, is_cvat
from lanestream_exporter.datasets.entries import LabelEntries
from lanestream_exporter.datasets.files import DataFolder, start_of
from lanestream_exporter.datasets.label_map import BY_WORDS, LabelMap
from lanestream_exporter.datasets.label_studio import is_label_studio, label_studio_entries
from lanestream_exporter.datasets.labelme import is_labelme, labelme_entries
from lanestream_exporter.datasets.masks import is_mask, mask_entries
from lanestream_exporter.datasets.other_programs import refuse_other_programs
from lanestream_exporter.datasets.tusimple import is_tusimple, tusimple_entries


@dataclass(frozen=True)
class LabelFormat:
    """A label format: `read` yields the entries of a data set.

    `recognizes` says whether a file holds such labels, by its path and the first bytes of a JSON or XML file.
    """

    read: Callable[[DataFolder], LabelEntries]
    recognizes: Callable[[Path, bytes], bool]

    def entries(self, folder: DataFolder, labels: LabelMap) -> LabelEntries:
        """Yields the entries of a data set. Raises LabelError if `labels` maps any: its boundaries have no labels."""
        if labels != BY_WORDS:
            raise LabelError(
                f"the boundaries in {folder.root} have no labels that could be mapped", "leave the label map out"
            )
        return self.read(folder)


@dataclass(frozen=True)
class DrawingFormat:
    """The label format of a drawing program: `read` yields the entries of a data set by what its labels mean.

    `recognizes` is that of LabelFormat.
    """

    read: Callable[[DataFolder, LabelMap], LabelEntries]
    recognizes: Callable[[Path, bytes], bool]

    def entries(self, folder: DataFolder, labels: LabelMap) -> LabelEntries:
        """Yields the entries of a data set, whose labels mean what `labels` says."""
        return self.read(folder, labels)


# A file belongs to the first format that recognizes it.
FORMATS: Final[Mapping[str, LabelFormat | DrawingFormat]] = {
    "tusimple": LabelFormat(tusimple_entries, is_tusimple),
    "culane": LabelFormat(culane_entries, is_culane),
    "caltech": LabelFormat(caltech_entries, is_caltech),
    "labelme": DrawingFormat(labelme_entries, is_labelme),
    "cvat": DrawingFormat(cvat_entries, is_cvat),
    "label-studio": DrawingFormat(label_studio_entries, is_label_studio),
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
