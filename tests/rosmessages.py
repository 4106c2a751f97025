"""Classes for ROS messages without ROS: made of their definitions, and as strict about types and ranges as rclpy's."""

from __future__ import annotations

import math
import re
from array import array
from pathlib import Path
from typing import Any, Final

import numpy as np

EXAMPLE: Final = Path(__file__).parents[1] / "examples" / "ros2"
_OWN: Final = EXAMPLE / "lanestream_msgs" / "msg"

# The fields of the messages of other packages that the bridge uses.
_DEFINITIONS: Final = {
    "Time": "int32 sec\nuint32 nanosec",
    "Duration": "int32 sec\nuint32 nanosec",
    "Header": "Time stamp\nstring frame_id",
    "Image": "Header header\nuint32 height\nuint32 width\nstring encoding\nuint32 step\nuint8[] data",
    "CompressedImage": "Header header\nstring format\nuint8[] data",
    "RegionOfInterest": "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify",
    "CameraInfo": "Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
    "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nRegionOfInterest roi",
    "Point": "float64 x\nfloat64 y\nfloat64 z",
    "Point32": "float32 x\nfloat32 y\nfloat32 z",
    "Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "Pose": "Point position\nQuaternion orientation",
    "Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a",
    "Marker": "int32 LINE_STRIP=4\nint32 ADD=0\nint32 DELETEALL=3\nHeader header\nstring ns\nint32 id\nint32 type\n"
    "int32 action\nPose pose\nVector3 scale\nColorRGBA color\nDuration lifetime\nPoint[] points",
    "MarkerArray": "Marker[] markers",
}
_FIELD: Final = re.compile(r"(?:\w+/)?(\w+)(\[\d*\])? +(\w+)(?: *= *(-?\d+))?")
_INTEGER: Final = re.compile(r"u?int(\d+)")


def message(name: str) -> Any:
    """Returns the class of a message."""
    text = (_OWN / f"{name}.msg").read_text() if (_OWN / f"{name}.msg").is_file() else _DEFINITIONS[name]
    fields: dict[str, tuple[str, str | None]] = {}
    constants: dict[str, int] = {}
    for line in text.splitlines():
        line = line.partition("#")[0].strip()
        if line:
            kind, size, field, value = re.fullmatch(_FIELD, line).groups()  # type: ignore[union-attr]
            if value is None:
                fields[field] = (kind, size)
            else:
                constants[field] = int(value)
    return type(name, (_Message,), {"_fields": fields, **constants})


class _Message:
    _fields: dict[str, tuple[str, str | None]]

    def __init__(self, **given: Any) -> None:
        for field, (kind, size) in self._fields.items():
            setattr(self, field, given.pop(field, _default(kind, size)))
        assert not given, f"{type(self).__name__} has no fields {given}"

    def __setattr__(self, field: str, value: Any) -> None:
        kind, size = self._fields[field]
        if size is None:
            _check(kind, value)
        else:
            assert size == "[]" or len(value) == int(size[1:-1]), f"{field} takes {size}"
            for item in [] if isinstance(value, (bytes, array)) else value:
                _check(kind, item)
        super().__setattr__(field, value)


def _default(kind: str, size: str | None) -> Any:
    if size is not None:
        return [_default(kind, None) for _ in range(int(size[1:-1] or 0))]
    if kind == "bool":
        return False
    if kind == "string":
        return ""
    if kind.startswith("float"):
        return 0.0
    return 0 if _INTEGER.fullmatch(kind) else message(kind)()


def _check(kind: str, value: Any) -> None:
    """Asserts what the setters of rclpy's messages assert."""
    if kind in ("bool", "string"):
        assert type(value) is {"bool": bool, "string": str}[kind], f"{value!r} is not a {kind}"
    elif kind.startswith("float"):
        assert isinstance(value, float), f"{value!r} is not a float"
        assert kind == "float64" or not math.isfinite(value) or abs(value) <= np.finfo(np.float32).max
    elif integer := _INTEGER.fullmatch(kind):
        bits, signed = int(integer[1]), not kind.startswith("u")
        least = -(1 << bits - 1) if signed else 0
        assert isinstance(value, int), f"{value!r} is not an int"
        assert least <= value < least + (1 << bits), f"{value} is not an {kind}"
    else:
        assert type(value).__name__ == kind, f"{value!r} is not a {kind}"
