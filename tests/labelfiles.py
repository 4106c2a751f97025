"""Writes label files of every format, and the images that they belong to."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.io import savemat

from lanestream.errors import LabelError
from lanestream.road.view import Image
from lanestream_exporter.datasets.checking import DatasetCheck
from lanestream_exporter.datasets.labels import LabeledFrame
from lanestream_exporter.datasets.reading import read_dataset, scan_dataset
from lanestream_exporter.scenes import render_still, sample_clip, sample_scene, write_clip

WIDTH, HEIGHT = 320, 180
LEFT = [[40.0, 170.0], [90.5, 130.0], [130.25, 100.0]]
RIGHT = [[290.0, 170.0], [230.0, 130.0], [185.5, 100.0]]
Points = list[list[float]]
Draw = Callable[[str], None]


@cache
def road() -> Image:
    """Returns a rendered image; callers must not change it."""
    return render_still(sample_scene(np.random.default_rng(3), WIDTH, HEIGHT)).image


def drawer(folder: Path) -> Draw:
    """Returns a function that writes the road to a file below `folder`, a different image each time."""
    written: list[str] = []

    def draw(name: str) -> None:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        written.append(name)
        image = road().copy()
        image[0, len(written)] = 255 - image[0, len(written)]
        # Lossless for every file name, so that exactly one pixel differs.
        path.write_bytes(cv2.imencode(".png", image)[1].tobytes())

    return draw


def write_drive(folder: Path) -> None:
    """Writes a rendered clip of three frames, drive.mp4, and its labels, drive.jsonl."""
    scene = sample_clip(np.random.default_rng(5), WIDTH, HEIGHT, frames=3, fps=25.0)
    write_clip(scene, folder / "drive.mp4", folder / "drive.jsonl")


def read(path: Path, format_name: str = "auto") -> list[LabeledFrame]:
    """Returns the labeled frames of a data set, and checks that their images have the right size."""
    frames = []
    for frame, image in read_dataset(path, format_name):
        assert image.shape == (frame.height, frame.width, 3)
        assert image.dtype == np.uint8
        frames.append(frame)
    return frames


def check_dataset(path: Path, format_name: str = "auto") -> DatasetCheck:
    """Returns the check of a whole data set."""
    check = DatasetCheck()
    for found in scan_dataset(path, format_name):
        check.add(found)
    return check


def faults(path: Path, format_name: str = "auto") -> list[str]:
    """Returns everything that is wrong with a data set."""
    return [str(found) for found in scan_dataset(path, format_name) if isinstance(found, LabelError)]


def tusimple_record(name: str, *lanes: list[float]) -> dict[str, Any]:
    return {"raw_file": name, "h_samples": [100, 130, 170], "lanes": list(lanes)}


def write_lines(path: Path, *records: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join((r if isinstance(r, str) else json.dumps(r)) + "\n" for r in records))


def clip_record(points: Any = None, **fields: Any) -> dict[str, Any]:
    lanes = [
        {"id": 4, "position": -1, "type": "solid", "color": "yellow", "points": LEFT if points is None else points}
    ]
    return {"frame": 0, "width": WIDTH, "height": HEIGHT, "lanes": lanes, **fields}


def labelme(path: Path, image: str, *shapes: dict[str, Any], **fields: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    record = {"version": "5.5.0", "flags": {}, "shapes": shapes, "imagePath": image, "imageData": None}
    path.write_text(json.dumps({**record, "imageHeight": HEIGHT, "imageWidth": WIDTH, **fields}))


def line_strip(points: Any, label: str = "lane", kind: str = "linestrip", **fields: Any) -> dict[str, Any]:
    return {"label": label, "points": points, "group_id": None, "shape_type": kind, "flags": {}, **fields}


def polyline(points: Points, inside: str = "", **attributes: Any) -> str:
    attribute_text = " ".join(f'{name}="{value}"' for name, value in {"label": "lane", **attributes}.items())
    return f'<polyline {attribute_text} points="{";".join(f"{x},{y}" for x, y in points)}">{inside}</polyline>'


def cvat_image(name: str, *shapes: str, width: int = WIDTH) -> str:
    return f'<image id="0" name="{name}" width="{width}" height="{HEIGHT}">{"".join(shapes)}</image>'


def write_cvat(path: Path, *elements: str, meta: str = "<task><name>monday</name></task>") -> None:
    body = f"<version>1.1</version><meta>{meta}</meta>{''.join(elements)}"
    path.write_text(f'<?xml version="1.0" encoding="utf-8"?>\n<annotations>{body}</annotations>')


def write_ccvl(path: Path, frames: list[tuple[Any, list[tuple[Any, ...]]]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    records = np.empty(len(frames), dtype=[("frame", object), ("labels", object)])
    for number, (name, labels) in enumerate(frames):
        fields = [(field, object) for field in ("points", "type", "subtype", "obj")]
        found = np.empty(len(labels), dtype=fields)
        for at, label in enumerate(labels):
            found[at] = label
        records[number] = (name, found)
    savemat(str(path), {"ld": {"version": 0.0, "source": "image", "frames": records}}, appendmat=False)


def write_manifest(path: Path, *datasets: dict[str, Any]) -> Path:
    """Writes a manifest of data sets; a value that is a table is given as a dict."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"[[dataset]]\n{_toml_lines(dataset)}\n" for dataset in datasets))
    return path


def _toml_lines(table: dict[str, Any]) -> str:
    return "".join(f"{key} = {_toml_value(value)}\n" for key, value in table.items())


def _toml_value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml_value(item)}" for key, item in value.items()) + " }"
    return json.dumps(value)


def write_mask(path: Path, mask: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), mask)


def draw_mask(*lines: tuple[Points, int], thickness: int = 5) -> NDArray[np.uint8]:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    for line, value in lines:
        cv2.polylines(mask, [np.array(line).round().astype(np.int32)], False, value, thickness)
    return mask
