"""The forms of labels that can be read, and telling them apart by their files."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Final

from lanestream.errors import LabelError
from lanestream_exporter.datasets import caltech, culane
from lanestream_exporter.datasets.caltech import caltech_entries
from lanestream_exporter.datasets.clips import clip_entries
from lanestream_exporter.datasets.culane import culane_entries
from lanestream_exporter.datasets.cvat import cvat_entries
from lanestream_exporter.datasets.entries import Reader
from lanestream_exporter.datasets.folder import DataFolder
from lanestream_exporter.datasets.labelme import labelme_entries
from lanestream_exporter.datasets.masks import is_mask, mask_entries
from lanestream_exporter.datasets.tusimple import tusimple_entries

FORMATS: Final[Mapping[str, Reader]] = {
    "tusimple": tusimple_entries,
    "culane": culane_entries,
    "caltech": caltech_entries,
    "labelme": labelme_entries,
    "cvat": cvat_entries,
    "masks": mask_entries,
    "clips": clip_entries,
}
_ACCEPTED: Final = f"{', '.join(FORMATS)} are read; say which with --format"
_PEEK: Final = 1 << 16  # bytes of a JSON or XML file that are looked at
_PEEKED_FILES: Final = 100


def detect(folder: DataFolder) -> str:
    """The form of the labels in `folder`. Raises LabelError where there are none, or of several forms."""
    found = {
        "culane": folder.with_suffix(culane.SUFFIX),
        "caltech": folder.with_suffix(caltech.SUFFIX),
        "masks": list(filter(is_mask, folder.files)),
    }
    names = {name for name, files in found.items() if files}
    text_files = folder.with_suffix(".json", ".jsonl", ".xml")
    names |= {name for file in islice(text_files, _PEEKED_FILES) if (name := _told_by(file)) is not None}
    if not names:
        raise LabelError(f"no labels that are known in {folder.root}", _ACCEPTED)
    if len(names) > 1:
        raise LabelError(
            f"{folder.root} has labels of several forms: {', '.join(sorted(names))}", "say which with --format"
        )
    return names.pop()


def _told_by(path: Path) -> str | None:
    """The form of a JSON or XML file, by the words at its beginning."""
    try:
        with path.open("rb") as file:
            start = file.read(_PEEK)
    except OSError:
        return None
    if path.suffix.lower() == ".xml":
        return "cvat" if b"<annotations" in start else None
    if b'"h_samples"' in start:
        return "tusimple"
    if b'"shapes"' in start or b'"imagePath"' in start or b'"imageData"' in start:
        return "labelme"
    return "clips" if b'"lanes"' in start and (b'"frame"' in start or b'"image"' in start) else None
