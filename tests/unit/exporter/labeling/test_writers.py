"""Pre-labels come back as they were written, and as they were corrected: points, kinds, types, colors and ids."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ElementTree

import cv2
import numpy as np
import pytest
from defusedxml.ElementTree import parse
from labelfiles import HEIGHT, WIDTH, read, road

from lanestream.errors import SourceError
from lanestream_exporter.datasets.labels import LabeledFrame, LabeledLane
from lanestream_exporter.labeling.difficulty import Difficulty
from lanestream_exporter.labeling.prelabels import PrelabeledFrame
from lanestream_exporter.labeling.writers import WRITERS, hardest_first, require_new, write_task

LEFT = np.array([[40.25, 170.5], [90.5, 130.01], [130.25, 100.33]])
RIGHT = np.array([[290.75, 171.0], [185.5, 100.0]])
EDGE = np.array([[310.0, 120.99], [200.01, 99.0]])
MOVED = [44.5, 168.25]
LANES = (
    LabeledLane(LEFT, 7, -1, "dashed", "yellow", "marking"),
    LabeledLane(RIGHT, 9, 1, None, None, "marking"),
    LabeledLane(EDGE, 12, 2, "edge", None, "road_edge"),
)
EASY, HARD = Difficulty(0.1, "left: 0.10 lane widths apart"), Difficulty(0.9, "left: only regression")


@pytest.fixture
def frames(tmp_path: Path) -> list[PrelabeledFrame]:
    """Returns two frames, the harder one last."""
    made = []
    for name, difficulty in (("easy", EASY), ("hard road", HARD)):
        path = tmp_path / f"{name}.png"
        image = road().copy()
        image[0, 0] = len(made)
        path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
        made.append(PrelabeledFrame(path, path.name, name, WIDTH, HEIGHT, LANES, difficulty))
    return made


def assert_same_lanes(frame: LabeledFrame, *, ids: bool = True) -> None:
    for lane, expected in zip(frame.lanes, LANES, strict=True):
        np.testing.assert_allclose(lane.points, expected.points, atol=0.01)
        assert (lane.kind, lane.type, lane.color) == (expected.kind, expected.type, expected.color)
        assert lane.lane_id == (expected.lane_id if ids else None)


def names(out: Path) -> list[str]:
    return sorted(path.name for path in (out / "images").glob("*.png"))


@pytest.mark.parametrize("format_name", WRITERS)
def test_the_hardest_frame_is_first_in_every_format(
    tmp_path: Path, frames: list[PrelabeledFrame], format_name: str
) -> None:
    out = tmp_path / "out"
    require_new(out)
    write_task(hardest_first(frames, None), out, format_name)
    assert names(out) == ["0001_hard road.png", "0002_easy.png"]
    rows = list(csv.DictReader((out / "difficulty.csv").read_text().splitlines()))
    assert rows == [
        {"image": "0001_hard road.png", "source": "hard road.png", "score": "0.900", "reason": HARD.reason},
        {"image": "0002_easy.png", "source": "easy.png", "score": "0.100", "reason": EASY.reason},
    ]
    assert hardest_first(frames, 1) == [frames[1]]


def test_a_folder_with_files_is_refused(tmp_path: Path, frames: list[PrelabeledFrame]) -> None:
    with pytest.raises(SourceError, match=r"is not empty .*so that no labels are overwritten"):
        require_new(tmp_path)
    with pytest.raises(SourceError, match="can't write"):
        require_new(frames[0].path / "out")


def written(tmp_path: Path, frames: list[PrelabeledFrame], format_name: str) -> Path:
    """Writes the frames and returns the file or folder to open."""
    out = tmp_path / "out"
    require_new(out)
    return write_task(hardest_first(frames, None), out, format_name)


def correct_cvat(path: Path) -> None:
    tree: ElementTree[Any] = parse(path)
    first = tree.find("image/polyline")
    assert first is not None
    first.set("points", f"{MOVED[0]},{MOVED[1]};" + first.attrib["points"].split(";", 1)[1])
    first.set("source", "manual")
    tree.write(path, encoding="utf-8")


def correct_labelme(folder: Path) -> None:
    path = min(folder.glob("*.json"))
    record = json.loads(path.read_text())
    record["shapes"][0]["points"][0] = MOVED
    path.write_text(json.dumps(record))


def export_from_label_studio(path: Path, moved: list[float] | None = None) -> None:
    """Replaces the tasks by what Label Studio exports after each prediction was accepted, one with a moved point."""
    tasks = json.loads(path.read_text())
    exported = []
    for number, task in enumerate(tasks, start=1):
        results = [{**result, "origin": "prediction"} for result in task["predictions"][0]["result"]]
        if moved is not None and number == 1:
            results[0]["value"]["vertices"][0] |= {"x": 100.0 * moved[0] / WIDTH, "y": 100.0 * moved[1] / HEIGHT}
        annotation = {"id": number, "completed_by": 1, "result": results, "was_cancelled": False, "ground_truth": False}
        exported.append({"id": number, "annotations": [annotation], "data": task["data"], "predictions": [number]})
    (path.parent / "project-1.json").write_text(json.dumps(exported))


def correct_label_studio(path: Path) -> None:
    export_from_label_studio(path, MOVED)


def test_cvat_returns_what_was_written(tmp_path: Path, frames: list[PrelabeledFrame]) -> None:
    path = written(tmp_path, frames, "cvat")
    for frame in read(path.parent):
        assert_same_lanes(frame)
    constructor = json.loads((path.parent / "labels.json").read_text())
    assert [(label["name"], label["type"]) for label in constructor] == [
        ("lane", "polyline"),
        ("road_edge", "polyline"),
    ]
    assert [attribute["name"] for attribute in constructor[0]["attributes"]] == ["type", "color", "id"]
    labels = parse(path).findall("meta/task/labels/label")
    assert [label.findtext("name") for label in labels] == ["lane", "road_edge"]


def test_single_images_have_no_ids_in_cvat(tmp_path: Path, frames: list[PrelabeledFrame]) -> None:
    lanes = tuple(LabeledLane(lane.points, None, None, lane.type, lane.color, lane.default_kind) for lane in LANES)
    single = PrelabeledFrame(frames[0].path, "easy.png", "easy", WIDTH, HEIGHT, lanes, EASY)
    path = written(tmp_path, [single], "cvat")
    assert 'name="id"' not in path.read_text()
    assert_same_lanes(read(path.parent)[0], ids=False)


def test_labelme_returns_what_was_written(tmp_path: Path, frames: list[PrelabeledFrame]) -> None:
    folder = written(tmp_path, frames, "labelme")
    for frame in read(folder.parent):
        assert_same_lanes(frame)
    assert (folder.parent / "labels.txt").read_text() == "lane\nroad_edge\n"
    shape = json.loads(min(folder.glob("*.json")).read_text())["shapes"][0]
    flags = (folder.parent / "flags.yaml").read_text()
    assert f"^lane$: [{', '.join(shape['flags'])}]" in flags


def test_label_studio_returns_what_was_written(tmp_path: Path, frames: list[PrelabeledFrame]) -> None:
    path = written(tmp_path, frames, "label-studio")
    tasks = json.loads(path.read_text())
    assert tasks[0]["data"]["image"] == "/data/local-files/?d=out/images/0001_hard%20road.png"
    export_from_label_studio(path)
    for frame in read(path.parent):
        assert_same_lanes(frame, ids=False)


def test_the_interface_of_label_studio_has_every_control_of_the_results(
    tmp_path: Path, frames: list[PrelabeledFrame]
) -> None:
    path = written(tmp_path, frames, "label-studio")
    config = parse(path.parent / "config.xml")
    values = {
        control.attrib["name"]: {choice.attrib["value"] for choice in control}
        for control in config.iter()
        if control.tag in ("VectorLabels", "Choices")
    }
    results = [result for task in json.loads(path.read_text()) for result in task["predictions"][0]["result"]]
    assert {result["from_name"] for result in results} == set(values)
    for result in results:
        assert set(result["value"].get("choices") or result["value"]["vectorlabels"]) <= values[result["from_name"]]


def test_tusimple_returns_the_columns_at_its_rows(tmp_path: Path, frames: list[PrelabeledFrame]) -> None:
    path = written(tmp_path, frames, "tusimple")
    record = json.loads(path.read_text().splitlines()[0])
    assert (record["raw_file"], record["h_samples"][:3]) == ("images/0001_hard road.png", [0, 10, 20])
    for frame in read(path.parent):
        for lane, expected in zip(frame.lanes, LANES, strict=True):
            columns = np.interp(lane.points[:, 1], *expected.points[::-1, ::-1].T)
            np.testing.assert_allclose(lane.points[:, 0], columns, atol=0.01)
            assert lane.points[0, 1] - expected.points[0, 1] > -10.0


def test_culane_returns_the_points_that_were_written(tmp_path: Path, frames: list[PrelabeledFrame]) -> None:
    path = written(tmp_path, frames, "culane")
    assert path.read_text() == "/images/0001_hard road.png\n/images/0002_easy.png\n"
    for frame in read(path.parent):
        for lane, expected in zip(frame.lanes, LANES, strict=True):
            np.testing.assert_allclose(lane.points, expected.points, atol=0.01)


@pytest.mark.parametrize(
    ("format_name", "correct"),
    [("cvat", correct_cvat), ("labelme", correct_labelme), ("label-studio", correct_label_studio)],
)
def test_a_corrected_point_comes_back(
    tmp_path: Path, frames: list[PrelabeledFrame], format_name: str, correct: Callable[[Path], None]
) -> None:
    correct(written(tmp_path, frames, format_name))
    hard, easy = sorted(read(tmp_path / "out"), key=lambda frame: frame.source)
    np.testing.assert_allclose(hard.lanes[0].points, [MOVED, *LEFT[1:].tolist()], atol=0.01)
    np.testing.assert_allclose(easy.lanes[0].points, LEFT, atol=0.01)
