"""Labels of the Caltech Lanes data set: `.ccvl` files, which are MATLAB files with the structure `ld`.

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
from lanestream_exporter.datasets.entries import Entries, Entry
from lanestream_exporter.datasets.folder import DataFolder, drive_of, relative
from lanestream_exporter.datasets.labels import LabelledLane
from lanestream_exporter.datasets.pictures import Picture
from lanestream_exporter.datasets.polylines import points_of
from lanestream_exporter.datasets.records import placed

SUFFIX: Final = ".ccvl"
_STEPS: Final = 100  # of a curve's parameter, as in the data set's own evaluation
_SUBTYPES: Final[Mapping[str, tuple[str, str]]] = {
    "bw": ("dashed", "white"),
    "sw": ("solid", "white"),
    "dy": ("double", "yellow"),
    "by": ("dashed", "yellow"),
    "sy": ("solid", "yellow"),
}


def caltech_entries(folder: DataFolder) -> Entries:
    """The frames of all `.ccvl` files; a group is the folder of such a file, a clip, as cordova1."""
    for path in folder.with_suffix(SUFFIX):
        try:
            frames = _frames(path)
        except LabelError as error:
            yield error
            continue
        for number, frame in enumerate(frames, start=1):
            place = f"{path}: frame {number}"
            try:
                yield _entry(frame, place, path, folder)
            except (ValueError, TypeError, AttributeError, KeyError, OverflowError) as error:
                yield LabelError(f"{place}: {error}", "a frame needs a frame and labels with points and a type")
            except LabelError as error:
                yield placed(place, error)


def _frames(path: Path) -> list[Any]:
    try:
        found = loadmat(str(path), appendmat=False, struct_as_record=False, squeeze_me=True)
        return _items(found["ld"].frames)
    except OSError as error:
        raise LabelError(f"can't read {path}: {(error.strerror or str(error)).lower()}") from None
    except Exception as error:  # loadmat tells a broken file by whatever its parser trips over
        raise LabelError(
            f"{path} is no label file of the Caltech labeller: {error}", "a MATLAB file, version 5 to 7, is accepted"
        ) from None


def _entry(frame: Any, place: str, path: Path, folder: DataFolder) -> Entry:
    lanes, others = {}, []
    for number, label in enumerate(_items(frame.labels), start=1):
        points = points_of(np.atleast_2d(label.points))
        form = label.type if isinstance(label.type, str) else "unnamed"
        if form in ("spline", "line"):
            kind, colour = _SUBTYPES.get(str(label.subtype), (None, None))
            lane_id = int(label.obj) if np.size(label.obj) == 1 else None
            # Pixels count from one there, from zero here.
            curve = bezier(points) - 1.0 if form == "spline" else points - 1.0
            lanes[f"label {number}"] = LabelledLane(curve, lane_id, None, kind, colour)
        elif len(points):
            others.append(form)
    image = folder.find(path.parent / relative(frame.frame))
    group = drive_of(path.parent)
    return Entry(place, folder.name(image), group, Picture(image), lanes, others=tuple(others))


def _items(value: Any) -> list[Any]:
    """The elements of a MATLAB structure array, of which loadmat makes a single one a scalar."""
    return list(np.atleast_1d(value)) if np.size(value) else []


def bezier(control: FloatArray) -> FloatArray:
    """Points (101, 2) of the Bezier curve with the `control` points (N, 2), of degree N - 1, at even steps.

    Raises ValueError where they are not three or four.
    """
    if len(control) not in (3, 4):
        raise ValueError(f"a spline has {len(control)} control points; three or four are accepted")
    t = np.linspace(0.0, 1.0, _STEPS + 1)
    return np.stack(list(_weights(t, len(control) - 1)), axis=1) @ control


def _weights(t: FloatArray, degree: int) -> Iterator[FloatArray]:
    """Bernstein's polynomials at `t`, one a control point."""
    for k in range(degree + 1):
        yield comb(degree, k) * t**k * (1.0 - t) ** (degree - k)
