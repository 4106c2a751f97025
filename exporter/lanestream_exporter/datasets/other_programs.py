"""Label files of programs that are not read, so that the error names the program and the way out."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from lanestream.errors import LabelError
from lanestream_exporter.datasets.files import DataFolder, start_of

_MOST_FILES: Final = 100  # read to recognize a program


@dataclass(frozen=True)
class _Program:
    """How to recognize the files of a program, and what to do with them. `start` matches the start of a file."""

    suffixes: tuple[str, ...]
    start: re.Pattern[bytes]
    hint: str


_IMPORT: Final = 'import them into CVAT, draw the boundaries as polylines, and export "CVAT for images 1.1"'
_CONVERT: Final = (
    "convert them to clip labels, whose fields docs/training.md lists, or to TuSimple's or CULane's format"
)
_REDRAW: Final = "boxes draw no line; draw the boundaries as polylines with CVAT, or as line strips with LabelMe"
_JSON: Final = (".json", ".jsonl")

# A file belongs to the first program that recognizes it.
_PROGRAMS: Final[Mapping[str, _Program]] = {
    "COCO": _Program(_JSON, re.compile(rb'"category_id"|"supercategory"'), _IMPORT),
    "VIA (VGG Image Annotator)": _Program((*_JSON, ".csv"), re.compile(rb"shape_attributes"), _CONVERT),
    "Supervisely": _Program(_JSON, re.compile(rb'"geometryType"|"classTitle"'), _CONVERT),
    "Scalabel or BDD100K": _Program(_JSON, re.compile(rb'"poly2d"'), _CONVERT),
    "OpenLane": _Program(_JSON, re.compile(rb'"lane_lines"'), _CONVERT),
    "CurveLanes": _Program(_JSON, re.compile(rb'"Lines"'), _CONVERT),
    "LabelU": _Program(_JSON, re.compile(rb'"toolName"|lineTool'), _CONVERT),
    "Datumaro": _Program(_JSON, re.compile(rb'"dm_format_version"|"label_categories"|"media_type"'), _IMPORT),
    "LabelMe 3.0 (XML)": _Program((".xml",), re.compile(rb"<annotation>.*<pt>", re.DOTALL), _IMPORT),
    "Pascal VOC (labelImg)": _Program((".xml",), re.compile(rb"<annotation[\s>].*<filename>", re.DOTALL), _REDRAW),
    "YOLO": _Program((".txt",), re.compile(rb"\s*\d+([ \t]+[01]?\.\d+){4,}\s"), _IMPORT),
}  # fmt: skip


def refuse_other_programs(folder: DataFolder) -> None:
    """Raises LabelError if the data set has label files of a program that is not read."""
    suffixes = tuple({suffix for program in _PROGRAMS.values() for suffix in program.suffixes})
    for path in folder.with_suffix(*suffixes)[:_MOST_FILES]:
        start = start_of(path)
        for name, program in _PROGRAMS.items():
            if path.suffix.lower() in program.suffixes and _matches(program, start):
                raise LabelError(f"{path} has labels of {name}, which are not read", program.hint)


def _matches(program: _Program, start: bytes) -> bool:
    # The format of plain text is that of its first line.
    found = program.start.match(start) if program.suffixes == (".txt",) else program.start.search(start)
    return found is not None
