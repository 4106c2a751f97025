"""Reads CVAT's labels, "CVAT for images 1.1" and "CVAT for video 1.1". Polylines in the XML file are lane boundaries.

Labels mean what `label_map` says. Polygons, points and skeletons are converted as `shapes` explains, and `cvat_frames`
finds the images. The attributes
`type` (or `kind`), `color` (or `colour`), `position` and `id` of a shape are used; words of its label stand in for the
first two. A track's id is the boundary's id. Coordinates are taken as written.
Format: docs.cvat.ai/docs/dataset_management/formats/format-cvat and docs.cvat.ai/docs/other/xml_format.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import parse

from lanestream.errors import LabelError
from lanestream_exporter.datasets.cvat_frames import CvatExport, CvatFrame, frame_number
from lanestream_exporter.datasets.entries import LabelEntries, LabelEntry, size_of
from lanestream_exporter.datasets.files import DataFolder, error_at, field_error
from lanestream_exporter.datasets.label_map import LabelMap
from lanestream_exporter.datasets.labels import LabeledLane, points_of
from lanestream_exporter.datasets.shapes import DrawnBoundaries, DrawnShape, meaning_of, no_boundaries

_SHAPES: Final = frozenset({"polyline", "box", "polygon", "points", "cuboid", "skeleton", "ellipse", "mask"})
_WITH_POINTS: Final = frozenset({"polyline", "polygon", "points", "skeleton"})
_POSITION: Final = re.compile(r"[+-]?[1-9]")
_ACCEPTED: Final = "an XML file of CVAT, for images or for video, is accepted"


def is_cvat(path: Path, start: bytes) -> bool:
    """Whether the file at `path` holds CVAT labels, by its first bytes."""
    return path.suffix.lower() == ".xml" and b"<annotations" in start


def cvat_entries(folder: DataFolder, labels: LabelMap) -> LabelEntries:
    """Yields the frames of all XML files.

    A group is the folder of the images if their names have one, else the name of the task; of a video task, the video.
    Frames of a video task without a boundary are left out: CVAT lists those that nobody labeled, too.
    """
    for path in folder.with_suffix(".xml"):
        try:
            root = _root(path)
        except LabelError as error:
            yield error
            continue
        export = CvatExport(path, root, folder)
        yield from _image_entries(export, labels)
        yield from _track_entries(export, labels)


def _root(path: Path) -> Element:
    try:
        root = parse(path, forbid_dtd=True).getroot()
    except OSError as error:
        raise LabelError(f"can't read {path}: {(error.strerror or str(error)).lower()}") from None
    except ParseError as error:
        raise LabelError(f"{path}:{error.position[0]}: not XML: {error}", _ACCEPTED) from None
    except (DefusedXmlException, ValueError):
        raise LabelError(f"{path} declares entities or a document type", f"{_ACCEPTED}, without those") from None
    if root is None or root.tag != "annotations":
        raise LabelError(f"{path} is XML, but not of CVAT: its root element is not <annotations>", _ACCEPTED)
    return root


def _image_entries(export: CvatExport, labels: LabelMap) -> LabelEntries:
    left_out: Counter[str] = Counter()
    is_empty = True
    for image in export.root.iterfind("image"):
        location = f"{export.path}: image {image.get('name')}"
        try:
            size, drawn = _drawn_on(image, labels)
            if frame_number(image.attrib["name"]) is not None and not drawn.lanes and not drawn.unknown:
                left_out.update(drawn.others)
                continue
            task = export.task(int(image.get("task_id", 0)))
            frame = task.named_frame(image.attrib["name"], image.get("subset") or ".")
            yield _entry(location, frame, drawn, size)
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            yield field_error(location, error, "name, width and height, and a polyline points")
        except LabelError as error:
            yield error_at(location, error)
        is_empty = False
    if is_empty and left_out:
        yield no_boundaries(export.path, left_out)


def _drawn_on(image: Element, labels: LabelMap) -> tuple[tuple[int, int], DrawnBoundaries]:
    """Returns the size of an image and the boundaries that were drawn on it."""
    size = size_of(image.attrib["width"], image.attrib["height"])
    counts: Counter[str] = Counter()
    shapes = []
    for element in image:
        if element.tag in _SHAPES:
            counts[element.tag] += 1
            where = f"{element.tag} {counts[element.tag]}"
            shapes.append(_shape(element, where, element.get("label", ""), None, labels))
    return size, DrawnBoundaries.of(shapes, "CVAT", size[0])


def _entry(location: str, frame: CvatFrame, drawn: DrawnBoundaries, size: tuple[int, int] | None) -> LabelEntry:
    return LabelEntry(
        location, frame.source, frame.group, frame.image, drawn.lanes, size, frame.video, frame.index,
        converted=drawn.converted, others=drawn.others, unknown=drawn.unknown,
    )  # fmt: skip


def _shape(element: Element, where: str, label: str, lane_id: int | None, labels: LabelMap) -> DrawnShape:
    meaning = meaning_of(element.tag, label, labels)
    # The points of a skeleton are elements of their own.
    parts = list(element.iterfind("points")) if element.tag == "skeleton" else [element]
    matters = meaning != "ignore" and element.tag in _WITH_POINTS
    texts = [part.attrib["points"] for part in parts if part.get("outside") != "1"] if matters else []
    try:
        points = points_of([[float(n) for n in pair.split(",")] for text in texts for pair in text.split(";") if pair])
    except ValueError:
        raise ValueError(f"{where}: its points are not pairs of numbers") from None
    attributes = {str(a.get("name")).lower(): (a.text or "").strip().lower() for a in element.iterfind("attribute")}
    types, colors = ([attributes.get(name, "") for name in names] for names in (("type", "kind"), ("color", "colour")))
    look = labels.look(label, types, colors)
    position = attributes.get("position", "")
    if lane_id is None and attributes.get("id", "").isdecimal():
        lane_id = int(attributes["id"])
    lane_position = int(position) if _POSITION.fullmatch(position) else None
    lane = LabeledLane(points, lane_id, lane_position, look.type, look.color, look.default_kind)
    group = element.get("group_id", "0")
    return DrawnShape(where, element.tag, label, meaning, lane, lane_id if group == "0" else group)


def _track_entries(export: CvatExport, labels: LabelMap) -> LabelEntries:
    """Yields the frames in which a track has a visible shape that is a boundary."""
    frames: dict[int, list[DrawnShape]] = {}
    others: Counter[str] = Counter()
    for found in _track_shapes(export, labels):
        if isinstance(found, LabelError):
            yield found
        elif found[1].meaning != "ignore":
            frames.setdefault(found[0], []).append(found[1])
        else:
            others[found[1].name] += 1
    if not frames:
        yield from [no_boundaries(export.path, others)] if others else []
        return
    task = export.task()
    try:
        task.require_images()
        size = export.size
    except LabelError as error:
        yield error_at(str(export.path), error)
        return
    except ValueError as error:
        yield field_error(str(export.path), error, "an original_size of whole numbers")
        return
    for index in sorted(frames):
        location = f"{export.path}: frame {index}"
        try:
            yield _entry(
                location, task.numbered_frame(index), DrawnBoundaries.of(frames[index], "CVAT", size and size[0]), size
            )
        except LabelError as error:
            yield error_at(location, error)


def _track_shapes(export: CvatExport, labels: LabelMap) -> Iterator[tuple[int, DrawnShape] | LabelError]:
    """Yields the visible shapes of all tracks with their frames, and faulty ones as their errors."""
    for track in export.root.iterfind("track"):
        where = f"track {track.get('id')}"
        for element in track:
            if element.tag not in _SHAPES or element.get("outside") == "1":
                continue
            try:
                shape = _shape(element, where, track.get("label", ""), int(track.attrib["id"]), labels)
                yield int(element.attrib["frame"]), shape
            except (ValueError, KeyError) as error:
                yield field_error(f"{export.path}: {where}", error, "an id, and polylines with frame and points")
