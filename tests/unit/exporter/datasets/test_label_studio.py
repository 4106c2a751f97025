"""Label Studio's JSON export: vectors, polygons and key points in percent of the image, with choices per region."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labelfiles import HEIGHT, LEFT, RIGHT, WIDTH, Draw, Points, faults, read

SIZE = {"original_width": WIDTH, "original_height": HEIGHT, "image_rotation": 0}


def percent(points: Points) -> Points:
    return [[100.0 * x / WIDTH, 100.0 * y / HEIGHT] for x, y in points]


def vertices(points: Points) -> list[dict[str, Any]]:
    names = [f"p{number}" for number in range(len(points))]
    return [
        {"id": name, "x": x, "y": y, "prevPointId": before, "isBezier": False}
        for name, before, (x, y) in zip(names, [None, *names], percent(points), strict=False)
    ]


def region(kind: str, name: str = "r1", control: str = "boundary", **value: Any) -> dict[str, Any]:
    return {
        "id": name, "from_name": control, "to_name": "image", "type": kind, "origin": "manual", **SIZE, "value": value,
    }  # fmt: skip


def vector(points: Points, label: str = "lane", name: str = "r1", **value: Any) -> dict[str, Any]:
    return region("vectorlabels", name, vertices=vertices(points), closed=False, vectorlabels=[label], **value)


def annotation(*results: dict[str, Any], **fields: Any) -> dict[str, Any]:
    return {
        "id": 3, "completed_by": 1, "result": results, "was_cancelled": False, "ground_truth": False,
        "created_at": "2026-01-10T09:03:11.000000Z", "updated_at": "2026-01-10T09:03:11.000000Z", "lead_time": 41.2,
        **fields,
    }  # fmt: skip


def task(*annotations: dict[str, Any], image: str = "/data/local-files/?d=drive/images/a.jpg") -> dict[str, Any]:
    return {
        "id": 7, "annotations": annotations, "file_upload": None, "drafts": [], "predictions": [],
        "data": {"image": image}, "meta": {}, "total_annotations": len(annotations), "project": 2,
    }  # fmt: skip


def write(folder: Path, *tasks: Any, name: str = "project-2-at-2026-01-10.json") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(json.dumps(tasks))


@pytest.fixture
def drive(tmp_path: Path, draw: Draw) -> Path:
    draw("drive/images/a.jpg")
    return tmp_path / "drive"


def test_vectors_are_boundaries_in_pixels_of_the_image(drive: Path) -> None:
    type_choice = region("choices", control="lane_type", choices=["dashed"])
    color_choice = region("choices", control="lane_color", choices=["yellow"])
    write(drive, task(annotation(vector(LEFT), type_choice, color_choice, vector(RIGHT, "road_edge", "r2"))))
    (frame,) = read(drive)
    assert (frame.source, frame.group) == ("images/a.jpg", f"{drive.parent.name}/drive")
    assert [(lane.kind, lane.type, lane.color) for lane in frame.lanes] == [
        ("marking", "dashed", "yellow"),
        ("road_edge", "edge", None),
    ]
    for lane, points in zip(frame.lanes, (LEFT, RIGHT), strict=True):
        np.testing.assert_allclose(lane.points, points, atol=1e-9)


@pytest.mark.parametrize(
    "results",
    [
        [region("vector", vertices=vertices(LEFT), closed=False), region("labels", labels=["lane"])],
        [vector(LEFT[::-1])],
        # A point that was added later stands at the end of the list.
        [region("vectorlabels", vertices=[vertices(LEFT)[n] for n in (0, 2, 1)], closed=False, vectorlabels=["lane"])],
        [region("keypointlabels", f"k{x}", x=x, y=y, width=0.3, keypointlabels=["lane"]) for x, y in percent(LEFT)],
        [region("polygonlabels", points=percent(LEFT), closed=True, polygonlabels=["lane"])],
    ],
    ids=["label apart", "downwards", "inserted point", "key points", "polygon"],
)
def test_every_way_to_draw_a_boundary_is_read(drive: Path, results: list[dict[str, Any]]) -> None:
    write(drive, task(annotation(*results)))
    (frame,) = read(drive)
    np.testing.assert_allclose(frame.lanes[0].points, LEFT, atol=1e-9)
    assert len(frame.lanes) == 1


@pytest.mark.parametrize(
    "image",
    [
        "/data/upload/2/0f3c9a1e-a.jpg",
        "/data/local-files/?d=mnt/data/drive/images/a.jpg",
        "s3://bucket/drive/images/a.jpg",
        "https://example.org/files/a.jpg?token=1",
        "../../images/a.jpg",
    ],
)
def test_the_image_is_found_wherever_label_studio_had_it(drive: Path, image: str) -> None:
    write(drive, task(annotation(vector(LEFT)), image=image))
    assert read(drive)[0].source == "images/a.jpg"


def test_only_annotations_count(drive: Path, draw: Draw) -> None:
    draw("drive/images/b.jpg")
    old = annotation(vector(RIGHT), updated_at="2026-01-09T00:00:00Z")
    new = annotation(vector(LEFT), vector(RIGHT, name="r2"))
    skipped = annotation(was_cancelled=True)
    predicted = {**task(image="b.jpg"), "predictions": [{"result": [vector(LEFT)]}]}
    write(drive, task(new, old, skipped), predicted, task(skipped, image="b.jpg"))
    assert [len(frame.lanes) for frame in read(drive)] == [2]
    truth = {**old, "ground_truth": True}
    write(drive, task(new, truth), task(annotation(), image="b.jpg"))
    assert [len(frame.lanes) for frame in read(drive)] == [1, 0]


def test_predictions_alone_are_an_error(drive: Path) -> None:
    write(drive, {**task(), "predictions": [{"result": [vector(LEFT)]}]}, task(annotation(was_cancelled=True)))
    (fault,) = faults(drive)
    assert "none of the 2 tasks in" in fault
    assert "predictions are not labels: submit the tasks" in fault


@pytest.mark.parametrize(
    ("element", "expected"),
    [
        ({"image": "a.jpg", "label": [{"original_width": 5}]}, "is not a list of Label Studio's tasks (export"),
        (task(annotation(vector(LEFT)), image="gone.jpg"), "task 7: there is no file gone.jpg"),
        (task(annotation(vector(LEFT)), image="a.mp4"), "task 7: its data has no image whose name ends in .jpg"),
        (task(annotation({**vector(LEFT), "image_rotation": 90})), "region r1: its image was rotated"),
        (task(annotation(vector([[1.0, 2.0]]))), "region r1: it has one point; at least two are needed"),
        (task(annotation(vector(LEFT, "guardrail"))), "task 7: the label 'guardrail' of a line is not known"),
        (task(annotation({**vector(LEFT), "value": {}})), "task 7: there is no 'vectorlabels'"),
        (task(annotation(region("rectanglelabels", x=1, y=2, rectanglelabels=["lane"]))), "rectangle of Label Studio"),
        (task(annotation({**vector(LEFT), "original_width": 99})), "a.jpg is 320 x 180, but its labels are for 99"),
    ],
)
def test_what_can_not_be_used_is_reported(drive: Path, element: Any, expected: str) -> None:
    write(drive, element)
    (fault,) = faults(drive, "label-studio")
    assert expected in fault


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"isBezier": True}, "it is a curve; draw straight segments"),
        ({"prevPointId": "p0"}, "it branches; draw each boundary as a vector of its own"),
        ({"prevPointId": "gone"}, "it branches"),
    ],
)
def test_vectors_that_are_not_polylines_are_reported(drive: Path, change: dict[str, Any], expected: str) -> None:
    points = vertices(LEFT)
    points[2] |= change
    write(drive, task(annotation(region("vectorlabels", vertices=points, closed=False, vectorlabels=["lane"]))))
    (fault,) = faults(drive)
    assert f"region r1: {expected}" in fault
