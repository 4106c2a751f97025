"""Reads CVAT's labels, "CVAT for images 1.1" and "CVAT for video 1.1". Polylines in the XML file are lane boundaries.

The attributes `type` (or `kind`), `color` (or `colour`), `position` and `id` of a polyline are used; words of its
label stand in for the first two. A track's id is the boundary's id. Coordinates are taken as written.
Format: docs.cvat.ai/docs/dataset_management/formats/format-cvat and docs.cvat.ai/docs/other/xml_format.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import parse

from lanestream.errors import LabelError
from lanestream_exporter.datasets.entries import LabelEntries, LabelEntry, color_in, kind_in, numbered, size_of
from lanestream_exporter.datasets.files import DataFolder, drive_of, error_at, field_error, path_in_labels
from lanestream_exporter.datasets.images import ImageLocation
from lanestream_exporter.datasets.labels import LabeledLane, points_of

_SHAPES: Final = frozenset({"box", "polygon", "points", "cuboid", "skeleton", "ellipse", "mask"})
_POSITION: Final = re.compile(r"[+-]?[1-9]")
_ACCEPTED: Final = "an XML file of CVAT, for images or for video, is accepted"


def is_cvat(path: Path, start: bytes) -> bool:
    """Whether the file at `path` holds CVAT labels, by its first bytes."""
    return path.suffix.lower() == ".xml" and b"<annotations" in start


def cvat_entries(folder: DataFolder) -> LabelEntries:
    """Yields the frames of all XML files.

    A group is the folder of the images if their names have one, else the name of the task; of a video task, the video.
    """
    for path in folder.with_suffix(".xml"):
        try:
            root = _root(path)
        except LabelError as error:
            yield error
            continue
        for image in root.iterfind("image"):
            location = f"{path}: image {image.get('name')}"
            try:
                yield _image_entry(image, location, _Export(path, root, folder))
            except (ValueError, KeyError, TypeError, OverflowError) as error:
                yield field_error(location, error, "name, width and height, and a polyline points")
            except LabelError as error:
                yield error_at(location, error)
        yield from _track_entries(_Export(path, root, folder))


@dataclass(frozen=True)
class _Export:
    """One XML file in its folder."""

    path: Path
    root: Element
    folder: DataFolder

    def text(self, *paths: str) -> str:
        """Returns the text of the first of the elements at `paths` that has any."""
        found = (self.root.findtext(path) for path in paths)
        return next((text.strip() for text in found if text), "")


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


def _image_entry(image: Element, location: str, export: _Export) -> LabelEntry:
    name, base = path_in_labels(image.attrib["name"]), export.path.parent
    subset = path_in_labels(image.get("subset") or ".")
    found = export.folder.find(base / "images" / name, base / name, base / "images" / subset / name)
    lanes: list[LabeledLane] = []
    others: list[str] = []
    for shape in image:
        if shape.tag == "polyline":
            number = len(lanes) + 1
            lanes.append(_lane(shape, f"polyline {number}", shape.get("label", ""), None))
        elif shape.tag in _SHAPES:
            others.append(shape.tag)
    task = export.text(f"meta/project/tasks/task[id='{int(image.get('task_id', 0))}']/name", "meta/task/name")
    group = drive_of(found.parent) if len(name.parts) > 1 or not task else f"task {task}"
    size = size_of(image.attrib["width"], image.attrib["height"])
    source = export.folder.name(found)
    return LabelEntry(
        location, source, group, ImageLocation(found), numbered(lanes, "polyline"), size, others=tuple(others)
    )


def _lane(shape: Element, where: str, label: str, lane_id: int | None) -> LabeledLane:
    try:
        points = points_of([[float(n) for n in pair.split(",")] for pair in shape.attrib["points"].split(";") if pair])
    except ValueError:
        raise ValueError(f"{where}: its points are not pairs of numbers") from None
    attributes = {str(a.get("name")).lower(): (a.text or "").strip().lower() for a in shape.iterfind("attribute")}
    words = re.findall(r"[a-z]+", label.lower())
    kind = kind_in([attributes.get("type", ""), attributes.get("kind", ""), *words])
    color = color_in([attributes.get("color", ""), attributes.get("colour", ""), *words])
    position = attributes.get("position", "")
    if lane_id is None and attributes.get("id", "").isdecimal():
        lane_id = int(attributes["id"])
    return LabeledLane(points, lane_id, int(position) if _POSITION.fullmatch(position) else None, kind, color)


def _track_entries(export: _Export) -> LabelEntries:
    """Yields the frames in which a track has a visible polyline."""
    frames: dict[int, dict[str, LabeledLane]] = {}
    for track in export.root.iterfind("track"):
        where = f"track {track.get('id')}"
        for shape in track.iterfind("polyline"):
            if shape.get("outside") == "1":
                continue
            try:
                lane = _lane(shape, where, track.get("label", ""), int(track.attrib["id"]))
                frames.setdefault(int(shape.attrib["frame"]), {})[where] = lane
            except (ValueError, KeyError) as error:
                yield field_error(f"{export.path}: {where}", error, "an id, and polylines with frame and points")
    if not frames:
        return
    try:
        task = _VideoTask.of(export)
    except ValueError as error:
        yield field_error(str(export.path), error, "an original_size of whole numbers")
        return
    except LabelError as error:
        yield error_at(str(export.path), error)
        return
    for index in sorted(frames):
        location = f"{export.path}: frame {index}"
        try:
            yield task.entry(index, location, frames[index])
        except LabelError as error:
            yield error_at(location, error)


@dataclass(frozen=True)
class _VideoTask:
    """A video task and where its frames are: exported as images next to the labels, or else in the video.

    If there is no folder `images` next to the labels, the video is looked for there and in the folder `clips`.
    """

    export: _Export
    video: Path | None
    group: str
    size: tuple[int, int] | None

    @classmethod
    def of(cls, export: _Export) -> _VideoTask:
        name = export.text("meta/task/source", "meta/source") or export.text("meta/task/name") or export.path.stem
        source, folder, base = path_in_labels(name), export.folder, export.path.parent
        size = [
            export.text(f"meta/task/original_size/{side}", f"meta/original_size/{side}") for side in ("width", "height")
        ]
        video = None
        if not (base / "images").is_dir():
            video = folder.find(base / source, folder.root / source, folder.root / "clips" / source)
        return cls(export, video, source.stem, size_of(*size) if all(size) else None)

    def entry(self, index: int, location: str, lanes: dict[str, LabeledLane]) -> LabelEntry:
        """Returns the entry of a frame. Raises LabelError if its image is missing."""
        if self.video is not None:
            source, image = f"{self.video.name}#{index}", ImageLocation(self.video, index)
        else:
            path = self.export.folder.find_image(self.export.path.parent / "images" / f"frame_{index:06d}")
            source, image = self.export.folder.name(path), ImageLocation(path)
        return LabelEntry(location, source, self.group, image, lanes, self.size, self.video, index)
