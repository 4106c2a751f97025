"""Writes Label Studio's files: tasks.json to import, with predictions, and config.xml, the labeling interface.

Boundaries are vectors; type and color are choices per region. Formats: labelstud.io/guide/predictions and
labelstud.io/tags/vectorlabels.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from lanestream_exporter.datasets.entries import UNKNOWN
from lanestream_exporter.datasets.labels import LabeledLane
from lanestream_exporter.labeling.tasks import COLORS, IMAGES, LABELS, TYPES, LabelImage, kind_of, type_of

_MODEL: Final = "lanestream"
_LOCAL_FILES: Final = "/data/local-files/?d="
_CONFIG: Final = f"""<View>
  <Image name="image" value="$image" zoom="true"/>
  <VectorLabels name="boundary" toName="image" closable="false" curves="false" strokeWidth="2">
    <Label value="{LABELS["marking"]}" background="#33ddff"/>
    <Label value="{LABELS["road_edge"]}" background="#ff9f1c"/>
  </VectorLabels>
{{choices}}</View>
"""
_CHOICES: Final = """  <Choices name="{name}" toName="image" perRegion="true" choice="single" showInline="true"
           visibleWhen="region-selected" whenTagName="boundary" whenLabelValue="{label}">
{values}  </Choices>
"""


def write_label_studio(images: Sequence[LabelImage], out: Path) -> Path:
    """Writes the pre-labels of `images` to the folder `out` and returns the file to import."""
    prefix = f"{_LOCAL_FILES}{quote(out.resolve().name)}/{IMAGES}"
    tasks = [
        {
            "data": {"image": f"{prefix}/{quote(image.name)}"},
            "predictions": [{"model_version": _MODEL, "result": list(_results(image))}],
        }
        for image in images
    ]
    path = out / "tasks.json"
    path.write_text(json.dumps(tasks, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    (out / "config.xml").write_text(_config(), encoding="utf-8")
    return path


def _config() -> str:
    parts = [(f"{LABELS[kind]}_type", LABELS[kind], TYPES[kind]) for kind in LABELS]
    parts.append((f"{LABELS['marking']}_color", LABELS["marking"], (*COLORS, UNKNOWN)))
    choices = [
        _CHOICES.format(name=name, label=label, values="".join(f'    <Choice value="{value}"/>\n' for value in values))
        for name, label, values in parts
    ]
    return _CONFIG.format(choices="".join(choices))


def _results(image: LabelImage) -> Iterator[dict[str, Any]]:
    """Yields the results of an image: for each boundary a vector, and its choices with the same id."""
    size = {"original_width": image.width, "original_height": image.height, "image_rotation": 0}
    for number, lane in enumerate(image.lanes, start=1):
        label = LABELS[kind_of(lane)]
        region = {"id": f"boundary-{number}", "to_name": "image", **size}
        drawn = {"vertices": list(_vertices(lane, image)), "closed": False}
        yield {**region, "from_name": "boundary", "type": "vectorlabels", "value": {**drawn, "vectorlabels": [label]}}
        choices = {f"{label}_type": type_of(lane), f"{label}_color": lane.color}
        for name, choice in choices.items():
            if choice is not None:
                yield {**region, "from_name": name, "type": "choices", "value": {**drawn, "choices": [choice]}}


def _vertices(lane: LabeledLane, image: LabelImage) -> Iterator[dict[str, Any]]:
    """Yields the points of a boundary as percentages of the image's size, each with the one before it."""
    before = None
    for number, (x, y) in enumerate(lane.points.tolist(), start=1):
        name = f"point-{number}"
        yield {
            "id": name, "x": 100.0 * x / image.width, "y": 100.0 * y / image.height, "prevPointId": before,
            "isBezier": False,
        }  # fmt: skip
        before = name
