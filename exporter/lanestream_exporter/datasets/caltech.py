"""Reads the Caltech Lanes data set: `.ccvl` files, which are MATLAB files with the structure `ld`.

`ld.frames` has a `frame` (the image's file name) and `labels`, each with `points`, a `type` (a spline has the three or
four control points of a Bezier curve, a line its ends), a `subtype` (bw, sw, dy, by, sy: broken or solid white, double,
broken or solid yellow) and an `obj`, the physical boundary that it belongs to. Pixels count from one, as in MATLAB.
Source: ccvLabel.m and ccvEvalBezSpline.m of M. Aly's Caltech lane detection software, 2009.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import comb
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.io import loadmat

from lanestream.errors import LabelError
from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.entries import LabelEntries, LabelEntry
from lanestream_exporter.datasets.files import DataFolder, drive_of, error_at, path_in_labels
from lanestream_exporter.datasets.images import ImageLocation
from lanestream_exporter.datasets.labels import LabeledLane, points_of

_SUFFIX: Final = ".ccvl"
_CURVE_STEPS: Final = 100  # of the curve parameter, as in the data set's own evaluation
_SUBTYPES: Final[Mapping[str, tuple[str, str]]] = {
    "bw": ("dashed", "white"),
    "sw": ("solid", "white"),
    "dy": ("double", "yellow"),
    "by": ("dashed", "yellow"),
    "sy": ("solid", "yellow"),
}


def is_caltech(path: Path, _start: bytes) -> bool:
    """Whether the file at `path` holds Caltech labels."""
    return path.name.lower().endswith(_SUFFIX)


def caltech_entries(folder: DataFolder) -> LabelEntries:
    """Yields the frames of all `.ccvl` files. A group is the folder of such a file, a clip, such as cordova1."""
    for path in folder.with_suffix(_SUFFIX):
        try:
            frames = _frames(path)
        except LabelError as error:
            yield error
            continue
        for number, frame in enumerate(frames, start=1):
            location = f"{path}: frame {number}"
            try:
                yield _entry(frame, location, path, folder)
            except (ValueError, TypeError, AttributeError, KeyError, OverflowError) as error:
                yield LabelError(f"{location}: {error}", "a frame needs a frame and labels with points and a type")
            except LabelError as error:
                yield error_at(location, error)


def _frames(path: Path) -> list[Any]:
    try:
        found = loadmat(str(path), appendmat=False, struct_as_record=False, squeeze_me=True)
        return _items(found["ld"].frames)
    except OSError as error:
        raise LabelError(f"can't read {path}: {(error.strerror or str(error)).lower()}") from None
    except Exception as error:  # loadmat raises many types of errors for broken files
        raise LabelError(
            f"{path} is not a label file of the Caltech labeler: {error}", "a MATLAB file, version 5 to 7, is accepted"
        ) from None


def _entry(frame: Any, location: str, path: Path, folder: DataFolder) -> LabelEntry:
    lanes, others = {}, []
    for number, label in enumerate(_items(frame.labels), start=1):
        points = points_of(np.atleast_2d(label.points))
        shape = label.type if isinstance(label.type, str) else "unnamed"
        if shape in ("spline", "line"):
            kind, color = _SUBTYPES.get(str(label.subtype), (None, None))
            lane_id = int(label.obj) if np.size(label.obj) == 1 else None
            # These labels count pixels from one, this project from zero.
            curve = bezier(points) - 1.0 if shape == "spline" else points - 1.0
            lanes[f"label {number}"] = LabeledLane(curve, lane_id, None, kind, color)
        elif len(points):
            others.append(shape)
    image = folder.find(path.parent / path_in_labels(frame.frame))
    group = drive_of(path.parent)
    return LabelEntry(location, folder.name(image), group, ImageLocation(image), lanes, others=tuple(others))


def _items(value: Any) -> list[Any]:
    """Returns the elements of a MATLAB structure array; loadmat turns an array of one element into a scalar."""
    return list(np.atleast_1d(value)) if np.size(value) else []


def bezier(control: FloatArray) -> FloatArray:
    """Returns points (101, 2) at even parameter steps of the Bezier curve with the `control` points (N, 2).

    Raises ValueError unless there are three or four control points.
    """
    if len(control) not in (3, 4):
        raise ValueError(f"a spline has {len(control)} control points; three or four are accepted")
    t = np.linspace(0.0, 1.0, _CURVE_STEPS + 1)
    return np.stack(list(_bernstein(t, len(control) - 1)), axis=1) @ control


def _bernstein(t: FloatArray, degree: int) -> Iterator[FloatArray]:
    """Yields Bernstein's polynomials at `t`, one per control point."""
    for k in range(degree + 1):
        yield comb(degree, k) * t**k * (1.0 - t) ** (degree - k)
