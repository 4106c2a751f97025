"""Writes "CVAT for images 1.1": annotations.xml to upload, and labels.json with the labels of the task.

Format: docs.cvat.ai/docs/dataset_management/formats/format-cvat. The constructor of labels in CVAT takes labels.json.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from xml.etree.ElementTree import Element, ElementTree, SubElement, indent

from lanestream.road.appearance import BoundaryKind
from lanestream_exporter.datasets.entries import UNKNOWN
from lanestream_exporter.datasets.labels import LabeledLane
from lanestream_exporter.labeling.tasks import COLORS, LABELS, TYPES, LabelImage, kind_of, type_of


@dataclass(frozen=True)
class _Attribute:
    """An attribute of a label; the first of its `values` is the default."""

    name: str
    input_type: str
    values: tuple[str, ...]


_LINE_COLORS: Final[Mapping[BoundaryKind, str]] = {"marking": "#33ddff", "road_edge": "#ff6037"}


def write_cvat(images: Sequence[LabelImage], out: Path) -> Path:
    """Writes the pre-labels of `images` to the folder `out` and returns the file to upload."""
    root = Element("annotations")
    SubElement(root, "version").text = "1.1"
    task = SubElement(SubElement(root, "meta"), "task")
    for name, text in (("name", out.resolve().name), ("size", str(len(images))), ("mode", "annotation")):
        SubElement(task, name).text = text
    labels = SubElement(task, "labels")
    attributes = {kind: tuple(_attributes(kind, images)) for kind in LABELS}
    for kind in LABELS:
        _add_label(labels, kind, attributes[kind])
    for number, image in enumerate(images):
        size = {"width": str(image.width), "height": str(image.height)}
        element = SubElement(root, "image", {"id": str(number), "name": image.name, **size})
        for lane in image.lanes:
            _add_polyline(element, lane, attributes[kind_of(lane)])
    indent(root)
    path = out / "annotations.xml"
    ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    (out / "labels.json").write_text(json.dumps(_constructor(attributes), indent=2) + "\n", encoding="utf-8")
    return path


def _attributes(kind: BoundaryKind, images: Sequence[LabelImage]) -> Iterator[_Attribute]:
    """Yields the attributes of a label. Boundaries have an id only in the frames of a video."""
    yield _Attribute("type", "select", TYPES[kind])
    if kind == "marking":
        yield _Attribute("color", "select", (UNKNOWN, *COLORS))
    if any(lane.lane_id is not None for image in images for lane in image.lanes):
        yield _Attribute("id", "text", ("",))


def _add_label(labels: Element, kind: BoundaryKind, attributes: Sequence[_Attribute]) -> None:
    label = SubElement(labels, "label")
    for name, text in (("name", LABELS[kind]), ("color", _LINE_COLORS[kind]), ("type", "polyline")):
        SubElement(label, name).text = text
    described = SubElement(label, "attributes")
    for attribute in attributes:
        element = SubElement(described, "attribute")
        fields = {
            "name": attribute.name, "mutable": "False", "input_type": attribute.input_type,
            "default_value": attribute.values[0], "values": "\n".join(attribute.values),
        }  # fmt: skip
        for field, text in fields.items():
            SubElement(element, field).text = text


def _add_polyline(image: Element, lane: LabeledLane, attributes: Sequence[_Attribute]) -> None:
    points = ";".join(f"{x:.2f},{y:.2f}" for x, y in lane.points)
    drawn = {"label": LABELS[kind_of(lane)], "source": "auto", "occluded": "0", "points": points, "z_order": "0"}
    polyline = SubElement(image, "polyline", drawn)
    given = {"type": type_of(lane), "color": lane.color or UNKNOWN, "id": str(lane.lane_id)}
    for attribute in attributes:
        SubElement(polyline, "attribute", {"name": attribute.name}).text = given[attribute.name]


def _constructor(attributes: Mapping[BoundaryKind, Sequence[_Attribute]]) -> list[dict[str, Any]]:
    """Returns the labels as the raw text of CVAT's constructor."""
    return [
        {
            "name": LABELS[kind],
            "color": _LINE_COLORS[kind],
            "type": "polyline",
            "attributes": [
                {
                    "name": attribute.name,
                    "input_type": attribute.input_type,
                    "mutable": False,
                    "values": list(attribute.values),
                    "default_value": attribute.values[0],
                }
                for attribute in attributes[kind]
            ],
        }
        for kind in LABELS
    ]
