"""Shapes of drawing tools: which of them are boundaries, and how polygons and points become lines.

`label_map` says which labels mean boundaries. A line whose label means nothing is an error, because it may be one; such
a shape of another tool is ignored.

- A polygon along a marking becomes the line midway between its left and its right side. A polygon that only goes one
  way was meant as a line, and its points are taken as they are. A thick polygon is an area, which is refused.
- Points are joined from the lowest row upwards.
- Points and polygons of the same group are one boundary, such as the dashes of one line. Single points without a group
  belong together if they have the same label.
- A boundary of any other tool, such as a box or a brush, is refused.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote
from typing import Final

import numpy as np

from lanestream.errors import LabelError, one_line
from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.label_map import MEANINGS, LabelMap, Meaning
from lanestream_exporter.datasets.labels import LabeledLane

_HOW_TO_DRAW: Final = (
    "draw each boundary as a polyline or line strip; polygons along a marking and points are converted if their label "
    "has a word like lane, line, marking or kerb, or if the label map names it"
)

_LINES: Final = frozenset({"polyline", "linestrip", "line", "vector"})
_POINTS: Final = frozenset({"points", "point", "skeleton"})
_POLYGON: Final = "polygon"
_THICKEST: Final = 0.05  # of the image's width, on average over a polygon's length
_SHARPEST_TURN: Final = 45.0  # degrees, of a polygon that was meant as a line
_TRIANGLE_TURN: Final = 20.0  # degrees, of one with three corners, which may be the outline of a marking that tapers
_LONGEST_LABEL: Final = 80  # characters in errors
_LEAST_STEP: Final = 3.0  # pixels sideways that count as a change of direction


@dataclass(frozen=True)
class DrawnShape:
    """A labeled shape: where it stands in its record, its tool, its label and what that means, and the boundary.

    `meaning` is None for a line whose label means nothing. `lane` has the shape's points as they were drawn; they may
    be left out if it is not a boundary. `group` is what shapes of the same object share.
    """

    where: str
    tool: str
    label: str
    meaning: Meaning | None
    lane: LabeledLane
    group: object = None

    @property
    def name(self) -> str:
        """Tool and label, as reports name the shape."""
        return f"{self.tool} {self.label!r}"


@dataclass(frozen=True)
class DrawnBoundaries:
    """The boundaries among the shapes of a frame by where they stand, and the tools of converted ones.

    `others` names the shapes that are not boundaries, and `unknown` has the labels of lines that may be.
    """

    lanes: Mapping[str, LabeledLane]
    converted: tuple[str, ...]
    others: tuple[str, ...]
    unknown: tuple[str, ...]

    @classmethod
    def of(cls, shapes: Iterable[DrawnShape], program: str, image_width: int | None) -> DrawnBoundaries:
        """Returns the boundaries among `shapes`, as this module explains. `program` is the one that drew them.

        Polygons are not checked for their thickness if `image_width` is unknown. Raises LabelError for a shape that
        must be a boundary by its label, but can't be converted.
        """
        lanes: dict[str, LabeledLane] = {}
        others: list[str] = []
        unknown: list[str] = []
        parts: dict[object, list[DrawnShape]] = defaultdict(list)
        for shape in shapes:
            if shape.meaning is None:
                unknown.append(shape.label)
            elif shape.meaning == "ignore":
                others.append(shape.name)
            elif shape.tool in _LINES:
                lanes[shape.where] = shape.lane
            elif shape.tool in _POINTS or shape.tool == _POLYGON:
                parts[_object_of(shape)].append(shape)
            else:
                message = (
                    f"{shape.where} is labeled {shape.label!r}, but the tool {shape.tool} of {program} draws no line"
                )
                raise LabelError(message, _HOW_TO_DRAW)
        for same in parts.values():
            first = same[0]
            try:
                lanes[first.where] = replace(first.lane, points=_line_of(same, image_width))
            except ValueError as error:
                raise LabelError(f"{first.where} {first.label!r}: {error}", _HOW_TO_DRAW) from None
        converted = tuple(shape.tool for same in parts.values() for shape in same)
        return cls(lanes, converted, tuple(others), tuple(unknown))


def no_boundaries(path: Path, others: Counter[str]) -> LabelError:
    """Returns the error of labels at `path` with shapes of these names and numbers, of which none is a boundary."""
    drawn = ", ".join(f"{name} ({count})" for name, count in others.most_common(3))
    return LabelError(f"none of the shapes in {path} is taken for a lane boundary: {drawn}", _HOW_TO_DRAW)


def unknown_label(location: str, label: str) -> LabelError:
    """Returns the error of a line at `location` whose label means nothing."""
    means, name = ", ".join(MEANINGS[:-1]), one_line(label, _LONGEST_LABEL)
    return LabelError(
        f"{location}: the label {name!r} of a line is not known",
        f"say what it means, {means} or {MEANINGS[-1]}: with --label {quote(f'{name}=ignore')}, or with "
        f"labels = {{ ignore = [{json.dumps(name, ensure_ascii=False)}] }} in the manifest; labels with a word like "
        "lane, line or kerb are known",
    )


def meaning_of(tool: str, label: str, labels: LabelMap) -> Meaning | None:
    """Returns what a shape is; None for a line whose label means nothing. Other tools than lines draw such things."""
    return labels.meaning_of_line(label) if tool in _LINES else labels.meaning(label) or "ignore"


def center_line(outline: FloatArray, image_width: int | None = None) -> FloatArray:
    """Returns the line (M, 2) along a polygon, from its lowest row upwards; `outline` (N, 2) are its corners.

    The line is midway between the left and the right side in the rows of all corners. Ends that are cut off at an angle
    are left out, because the middle of the last corner is not that of the marking. Raises ValueError if the polygon is
    too thick to be a marking.
    """
    rows = np.unique(outline[:, 1])[::-1]
    if len(rows) < 2:
        return outline
    drawn_as_line = _one_way(outline)
    if drawn_as_line is not None:
        return drawn_as_line
    sides = np.array([_sides(outline, row) for row in rows])
    keep = _without_caps(rows, sides[:, 1] - sides[:, 0])
    line = np.stack([sides.mean(axis=1), rows], axis=1)[keep]
    length = float(np.hypot(*np.diff(line, axis=0).T).sum())
    if image_width is not None and _area(outline) > _THICKEST * image_width * length:
        thickness = _area(outline) / max(length, 1.0)
        raise ValueError(f"this polygon is {thickness:.0f} pixels thick, an area rather than a marking")
    return line


def _object_of(shape: DrawnShape) -> object:
    """Returns what the parts of one boundary have in common."""
    if shape.group is not None:
        return "group", shape.group, shape.label
    return ("label", shape.label) if shape.tool in _POINTS and len(shape.lane.points) == 1 else ("shape", shape.where)


def _line_of(parts: Sequence[DrawnShape], image_width: int | None) -> FloatArray:
    """Returns the parts of one boundary as a line. Raises ValueError if they don't follow one."""
    if not all(np.isfinite(part.lane.points).all() for part in parts):
        raise ValueError("one of its points is not a number")
    lines = [
        center_line(part.lane.points, image_width) if part.tool == _POLYGON else part.lane.points for part in parts
    ]
    if len(parts) == 1 and parts[0].tool == _POLYGON:
        return lines[0]
    points = np.concatenate(lines)
    joined = points[np.argsort(-points[:, 1], kind="stable")]
    most_turns = 1 if parts[0].group is None else 2
    if _turns(joined) > most_turns:
        raise ValueError("its points turn left and right, so they are not of one boundary; give each boundary a group")
    return joined


def _turns(line: FloatArray) -> int:
    """Returns how often a line changes its direction between left and right."""
    steps = np.diff(line[:, 0])
    signs = np.sign(steps[np.abs(steps) > _LEAST_STEP])
    return int((np.diff(signs) != 0).sum())


def _one_way(outline: FloatArray) -> FloatArray | None:
    """Returns the corners of a polygon that goes up without a sharp turn and straight back to its start, else None."""
    from_lowest = np.roll(outline, -int(np.argmax(outline[:, 1])), axis=0)
    top = int(np.argmin(from_lowest[:, 1]))
    up, down = from_lowest[: top + 1], np.concatenate([from_lowest[top:], from_lowest[:1]])[::-1]
    if min(len(up), len(down)) > 2:
        return None
    line = up if len(down) <= 2 else down
    steps = np.diff(line, axis=0)
    directions = np.degrees(np.arctan2(steps[:, 1], steps[:, 0]))
    turns = np.abs((np.diff(directions) + 180.0) % 360.0 - 180.0)
    return line if (turns < (_TRIANGLE_TURN if len(line) == 3 else _SHARPEST_TURN)).all() else None


def _sides(outline: FloatArray, row: float) -> tuple[float, float]:
    """Returns the leftmost and the rightmost column of a polygon's outline in a row that it reaches."""
    start, end = outline, np.roll(outline, -1, axis=0)
    rise = end[:, 1] - start[:, 1]
    crosses = (np.minimum(start[:, 1], end[:, 1]) <= row) & (np.maximum(start[:, 1], end[:, 1]) >= row) & (rise != 0)
    share = (row - start[crosses, 1]) / rise[crosses]
    columns = start[crosses, 0] + share * (end[crosses, 0] - start[crosses, 0])
    return float(columns.min()), float(columns.max())


def _without_caps(rows: FloatArray, widths: FloatArray) -> slice:
    """Returns the rows of a polygon, from the lowest upwards, without those of ends that are cut off at an angle."""
    first, last = 0, len(rows)
    while last - first > 2 and _is_cap(rows[first] - rows[first + 1], widths[first], widths[first + 1]):
        first += 1
    while last - first > 2 and _is_cap(rows[last - 2] - rows[last - 1], widths[last - 1], widths[last - 2]):
        last -= 1
    return slice(first, last)


def _is_cap(height: float, end_width: float, next_width: float) -> bool:
    return height < next_width and end_width < next_width / 2.0


def _area(outline: FloatArray) -> float:
    x, y = outline.T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2.0)
