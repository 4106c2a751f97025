"""Reads Label Studio's labels: its JSON export, a list of tasks. Vectors that are not closed are lane boundaries.

Their labels mean what `label_map` says; polygons and key points are converted as `shapes` explains. Choices per region
may name type and color. Tasks without an annotation are left out: predictions are not labels. Of several annotations
the ground truth counts, else the newest one. Coordinates are percentages of the image's size.
Format: labelstud.io/guide/export and labelstud.io/tags/vectorlabels.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qs, unquote, urlsplit

import numpy as np

from lanestream.errors import LabelError
from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.entries import LabelEntries, LabelEntry, size_of
from lanestream_exporter.datasets.files import (
    IMAGE_FOLDERS,
    IMAGE_SUFFIXES,
    DataFolder,
    drive_of,
    error_at,
    field_error,
    json_value,
    path_in_labels,
    read_text,
    start_of,
)
from lanestream_exporter.datasets.images import ImageLocation
from lanestream_exporter.datasets.label_map import LabelMap, words_of
from lanestream_exporter.datasets.labels import LabeledLane, points_of
from lanestream_exporter.datasets.shapes import DrawnBoundaries, DrawnShape, meaning_of

_ACCEPTED: Final = "export the project as JSON, not as JSON-MIN or in another format"
_NEEDED: Final = "data, and annotations with a result"
# What Label Studio puts in front of the name of an uploaded file.
_UPLOAD: Final = re.compile(r"[0-9a-f]{8}-")
# The tools that `shapes` knows; others go by the name of their results.
_TOOLS: Final[Mapping[str, str]] = {"keypoint": "point"}

_Result = Mapping[str, Any]


def is_label_studio(path: Path, start: bytes) -> bool:
    """Whether the file at `path` holds labels or predictions of Label Studio, by its first bytes."""
    is_result = b'"from_name"' in start or b'"original_width"' in start
    is_task = b'"data"' in start and (b'"annotations"' in start or b'"predictions"' in start)
    return path.suffix.lower() == ".json" and (is_result or is_task)


def label_studio_entries(folder: DataFolder, labels: LabelMap) -> LabelEntries:
    """Yields the annotated tasks of all JSON files. A group is the folder of the images.

    It is an error if no task is annotated.
    """
    unlabeled, found = 0, False
    for path in folder.with_suffix(".json"):
        # A folder may hold JSON files of another kind, such as a camera's calibration.
        if not is_label_studio(path, start_of(path)):
            continue
        try:
            tasks = json_value(read_text(path, _ACCEPTED), str(path), _ACCEPTED)
        except LabelError as error:
            yield error
            continue
        if not isinstance(tasks, list) or not all(isinstance(task, dict) and "data" in task for task in tasks):
            yield LabelError(f"{path} is not a list of Label Studio's tasks", _ACCEPTED)
            continue
        for number, task in enumerate(tasks, start=1):
            entries = list(_entries(task, number, path, folder, labels))
            unlabeled, found = unlabeled + (not entries), found or bool(entries)
            yield from entries
    if unlabeled and not found:
        yield LabelError(
            f"none of the {unlabeled} tasks in {folder.root} is annotated",
            "predictions are not labels: submit the tasks in Label Studio, and export them as JSON",
        )


def _entries(task: Mapping[str, Any], number: int, path: Path, folder: DataFolder, labels: LabelMap) -> LabelEntries:
    """Yields the frame of a task that is annotated, or what is wrong with it."""
    location = f"{path}: task {task.get('id', number)}"
    try:
        annotation = _annotation(task)
        if annotation is not None:
            yield _entry(task, annotation["result"], location, path, folder, labels)
    except (ValueError, KeyError, TypeError, OverflowError, AttributeError) as error:
        yield field_error(location, error, _NEEDED)
    except LabelError as error:
        yield error_at(location, error)


def _annotation(task: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Returns the annotation that counts, if any. Skipped tasks have a cancelled one."""
    done = [each for each in task.get("annotations") or () if not each.get("was_cancelled")]
    return max(done, key=lambda each: (bool(each.get("ground_truth")), str(each.get("updated_at", ""))), default=None)


def _entry(
    task: Mapping[str, Any], results: Sequence[_Result], location: str, path: Path, folder: DataFolder, labels: LabelMap
) -> LabelEntry:
    regions: dict[str, list[_Result]] = {}
    for number, result in enumerate(results, start=1):
        if "original_width" in result:  # other results are of the whole task
            regions.setdefault(str(result.get("id", f"without an id, {number}")), []).append(result)
    sizes = {size_of(each["original_width"], each["original_height"]) for same in regions.values() for each in same}
    if len(sizes) > 1:
        raise ValueError(f"its regions are of images of {len(sizes)} sizes")
    size = next(iter(sizes), None)
    shapes = [_shape(same, f"region {name}", labels) for name, same in regions.items()]
    drawn = DrawnBoundaries.of(shapes, "Label Studio", size[0] if size else None)
    image = _image(task["data"], path, folder)
    return LabelEntry(
        location, folder.name(image), drive_of(image.parent), ImageLocation(image), drawn.lanes, size,
        converted=drawn.converted, others=drawn.others, unknown=drawn.unknown,
    )  # fmt: skip


def _shape(results: Sequence[_Result], where: str, labels: LabelMap) -> DrawnShape:
    """Returns the shape of a region: results with the same id give its geometry, its label and its choices."""
    label, types, colors = "", list[str](), list[str]()
    for result in results:
        kind, value = str(result["type"]), result["value"]
        if kind.endswith("labels"):
            label = str(next(iter(value[kind]), ""))
        elif kind == "choices":
            words = [word for choice in value["choices"] for word in words_of(str(choice))]
            (colors if "colo" in str(result.get("from_name", "")).lower() else types).extend(words)
    drawn = next((each for each in results if str(each["type"]) not in ("labels", "choices")), results[0])
    tool = _tool(drawn)
    meaning = meaning_of(tool, label, labels)
    try:
        points = points_of([]) if meaning == "ignore" else _points(drawn)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    look = labels.look(label, types, colors)
    return DrawnShape(
        where, tool, label, meaning, LabeledLane(points, None, None, look.type, look.color, look.default_kind)
    )


def _tool(result: _Result) -> str:
    name = str(result["type"]).removesuffix("labels")
    return "polygon" if name == "vector" and result["value"].get("closed") else _TOOLS.get(name, name)


def _points(result: _Result) -> FloatArray:
    """Returns the points (N, 2) of a region in pixels of its image; none of a tool without points."""
    if result.get("image_rotation"):
        raise ValueError("its image was rotated in Label Studio; rotate it back")
    value = result["value"]
    if "vertices" in value:
        percentages = [(vertex["x"], vertex["y"]) for vertex in _in_order(value["vertices"])]
    elif "points" in value:
        percentages = value["points"]
    else:
        percentages = [(value["x"], value["y"])] if _tool(result) == "point" else []
    points = points_of(percentages)
    return np.asarray(points * (result["original_width"], result["original_height"]) / 100.0)


def _in_order(vertices: Sequence[Mapping[str, Any]]) -> Iterator[Mapping[str, Any]]:
    """Yields the vertices along a vector: each names the one before. Raises ValueError for curves and branches."""
    if any(vertex.get("isBezier") for vertex in vertices):
        raise ValueError("it is a curve; draw straight segments")
    if not all("id" in vertex and "prevPointId" in vertex for vertex in vertices):
        yield from vertices
        return
    following = {vertex["prevPointId"]: vertex for vertex in vertices}
    vertex = following.pop(None, None)
    while vertex is not None:
        yield vertex
        vertex = following.pop(vertex["id"], None)
    if following or len({vertex["prevPointId"] for vertex in vertices}) < len(vertices):
        raise ValueError("it branches; draw each boundary as a vector of its own")


def _image(data: Mapping[str, Any], labels: Path, folder: DataFolder) -> Path:
    """Returns the file of a task's image: by as much of its path as is found next to the labels or in `images`."""
    texts = [text for text in data.values() if isinstance(text, str)]
    paths = [path for path in map(_path, texts) if path.suffix.lower() in IMAGE_SUFFIXES]
    if not paths:
        raise ValueError(f"its data has no image whose name ends in {', '.join(IMAGE_SUFFIXES)}")
    parts = [part for part in paths[0].parts if part not in ("..", "/", ".")]
    tails = [Path(*parts[start:]) for start in range(len(parts))]
    if _UPLOAD.match(parts[-1]):
        tails.append(Path(_UPLOAD.sub("", parts[-1], count=1)))
    folders = labels.parent, *(labels.parent / name for name in IMAGE_FOLDERS), folder.root
    return folder.find(*(base / tail for tail in tails for base in folders))


def _path(text: str) -> Path:
    """Returns the path in a URL, or the one that Label Studio's URL of a local file names."""
    url = urlsplit(text)
    named = parse_qs(url.query).get("d") if url.path.endswith("/local-files/") else None
    return path_in_labels(named[0] if named else unquote(url.path) or "-")
