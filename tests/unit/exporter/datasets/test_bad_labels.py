"""Every kind of bad record, in every label format, is reported with its location."""

from __future__ import annotations

import json
import shutil
from copy import deepcopy
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from labelfiles import (
    HEIGHT,
    LEFT,
    WIDTH,
    Draw,
    check_dataset,
    clip_record,
    cvat_image,
    draw_mask,
    drawer,
    faults,
    labelme,
    line_strip,
    polyline,
    read,
    road,
    tusimple_record,
    write_ccvl,
    write_cvat,
    write_lines,
    write_mask,
)

from lanestream.errors import LabelError
from lanestream_exporter.datasets.labels import checked_points
from lanestream_exporter.datasets.reading import LabeledSample, scan_dataset


def only_fault(path: Path, format_name: str = "auto") -> str:
    (fault,) = faults(path, format_name)
    assert "\n" not in fault
    with pytest.raises(LabelError) as raised:
        read(path, format_name)
    assert str(raised.value) == fault
    return fault


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ([], "lane 1: it has no points"),
        ([[10, 10]], "lane 1: it has one point"),
        ([[10, 20], [float("nan"), 10]], "lane 1: one of its points is not a number"),
        ([[10, 20], [None, 10]], "lane 1: one of its points is not a number"),
        ([[10, 150], [20, 100], [30, 120], [40, 80]], "lane 1: its rows go back down at (30, 120)"),
        ([[10, 150], [20, 150]], "lane 1: its points all lie on row 150"),
        ([[10, 150], [350, 100]], "lane 1: (350, 100) is outside the image of 320 x 180"),
        ([[10, 150, 1], [20, 100, 1]], "lane 1: its points are not pairs of numbers"),
        ([[10, 150], [20]], "lane 1: its points are not pairs of numbers"),
        ("road", "lane 1: its points are not pairs of numbers"),
    ],
)
def test_a_bad_lane_is_reported_with_line_and_number(tmp_path: Path, draw: Draw, points: Any, expected: str) -> None:
    draw("a.jpg")
    draw("b.jpg")
    good = clip_record(image="a.jpg")
    write_lines(tmp_path / "labels.jsonl", good, clip_record(points, image="b.jpg"))
    assert f"labels.jsonl:2: {expected}" in only_fault(tmp_path)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("{", "not JSON"),
        ("[1]", "not a JSON object"),
        ("[" * 100_000, "not readable JSON: nested too deeply"),
        (json.dumps({"frame": 0, "width": 1, "height": 1}), "there is no 'lanes'"),
        (json.dumps(clip_record(image="gone.jpg")), "there is no file gone.jpg"),
        (json.dumps(clip_record(image="../../etc/passwd")), "outside the data set's folder"),
        (json.dumps(clip_record(image="/etc/passwd")), "outside the data set's folder"),
        (json.dumps(clip_record(image="x" * 5000)), "there is no file x"),
        (json.dumps(clip_record(image=7)), "7 is not a path"),
        (json.dumps(clip_record(image="text.jpg")), "text.jpg: not an image: it looks like text"),
        (json.dumps(clip_record(image="cut.jpg")), "cut.jpg: the PNG image is cut short"),
        (json.dumps(clip_record(image="bomb.png")), "bomb.png: the image is 60000 x 60000"),
        (json.dumps(clip_record(image="a.jpg", width=640)), "a.jpg is 320 x 180, but its labels are for 640 x 180"),
        (json.dumps(clip_record()), "there is no file labels.mp4"),
    ],
)
def test_a_bad_record_is_reported_with_its_line(tmp_path: Path, draw: Draw, line: str, expected: str) -> None:
    draw("a.jpg")
    data = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "text.jpg").write_text("hello")
    (tmp_path / "cut.jpg").write_bytes(data[: len(data) // 2])
    (tmp_path / "bomb.png").write_bytes(data[:16] + (60000).to_bytes(4, "big") * 2 + data[24:])
    write_lines(tmp_path / "labels.jsonl", clip_record(image="a.jpg"), line)
    fault = only_fault(tmp_path, "clips")
    assert "labels.jsonl:2: " in fault
    assert expected in fault


def test_every_fault_is_reported_and_sound_records_are_still_read(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    draw("b.jpg")
    worst = clip_record(image="a.jpg", width=300, lanes=[{"points": []}, {"points": [[0, 0]]}, {"points": LEFT}])
    write_lines(tmp_path / "labels.jsonl", "{", worst, "[]", clip_record(image="b.jpg"))
    found = list(scan_dataset(tmp_path))
    assert [isinstance(one, LabeledSample) for one in found] == [False] * 5 + [True]
    assert [str(one).split(".jsonl:")[1][0] for one in found[:-1]] == ["1", "2", "2", "2", "3"]


def test_bad_tusimple_records_are_reported(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    short = tusimple_record("a.jpg", [1, 2])
    outside = tusimple_record("../a.jpg")
    turning = tusimple_record("a.jpg", [1, 2, 3]) | {"h_samples": [100, 170, 130]}
    missing = {"h_samples": [], "lanes": []}
    write_lines(tmp_path / "labels.json", short, outside, turning, missing, tusimple_record("a.jpg"))
    found = faults(tmp_path)
    assert "labels.json:1: lane 1 has 2 columns, but there are 3 h_samples" in found[0]
    assert "labels.json:2: " in found[1]
    assert "outside the data set's folder" in found[1]
    assert "labels.json:3: lane 1: its rows go back down" in found[2]
    assert "labels.json:4: there is no 'raw_file'" in found[3]
    assert len(found) == 4


def test_bad_culane_lines_are_reported(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    (tmp_path / "a.lines.txt").write_text("1 2 3\n1 100 5 90\nfar 1\n")
    (tmp_path / "b.lines.txt").write_text("1 100 5 90\n")
    found = faults(tmp_path)
    assert "a.lines.txt:1: 3 numbers are not pairs" in found[0]
    assert "a.lines.txt:3: could not convert string to float: 'far'" in found[1]
    assert "b.lines.txt: there is no file b.jpg" in found[2]
    assert len(found) == 3


def test_bad_caltech_files_are_reported(tmp_path: Path, draw: Draw) -> None:
    draw("a.png")
    two = np.array([[1.0, 100.0], [5.0, 90.0]])
    frames: list[tuple[Any, list[tuple[Any, ...]]]] = [
        ("a.png", [(two, "spline", "sw", 1)]),
        ("b.png", []),
        (3.0, []),
        ("a.png", [(two, "line", "sw", 1)]),
    ]
    write_ccvl(tmp_path / "labels.ccvl", frames)
    (tmp_path / "text.ccvl").write_text("not a MATLAB file, but long enough for a header of 128 bytes" * 3)
    found = faults(tmp_path)
    assert "labels.ccvl: frame 1: a spline has 2 control points" in found[0]
    assert "labels.ccvl: frame 2: there is no file b.png" in found[1]
    assert "labels.ccvl: frame 3: 3" in found[2]
    assert "text.ccvl is not a label file of the Caltech labeler" in found[3]
    assert len(found) == 4


def test_bad_labelme_files_are_reported(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    labelme(tmp_path / "1.json", "a.jpg", line_strip(LEFT), line_strip([[1, 2, 3]]))
    labelme(tmp_path / "2.json", "gone.jpg", line_strip(LEFT))
    labelme(tmp_path / "3.json", "gone.jpg", line_strip(LEFT), imageData="%")
    labelme(tmp_path / "4.json", "a.jpg", line_strip(LEFT), imageWidth=640)
    labelme(tmp_path / "5.json", "../../a.jpg", line_strip(LEFT))
    (tmp_path / "6.json").write_text('{"shapes": 3}')
    (tmp_path / "7.json").write_bytes(b"\xff\xfe\xff")
    found = faults(tmp_path)
    expected = [
        "1.json: shape 2: its points are not pairs",
        "2.json: there is no file gone.jpg",
        "3.json: its imageData is not base64",
        "4.json: a.jpg is 320 x 180, but its labels are for 640 x 180",
        "5.json: ",
        "6.json: ",
        "7.json is not a text file",
    ]
    assert all(word in line for word, line in zip(expected, found, strict=True))


def test_bad_cvat_elements_are_reported(tmp_path: Path, draw: Draw) -> None:
    draw("images/a.png")
    write_cvat(
        tmp_path / "annotations.xml",
        cvat_image("a.png", polyline(LEFT), '<polyline label="lane" points="1,2;x"/>'),
        cvat_image("gone.png"),
        cvat_image("a.png", polyline(LEFT), polyline([[1, 2]])),
        cvat_image("../../secret.png"),
        cvat_image("a.png", width=640),
    )
    found = faults(tmp_path)
    expected = [
        "annotations.xml: image a.png: polyline 2: its points are not pairs",
        "annotations.xml: image gone.png: there is no file images/gone.png",
        "annotations.xml: image a.png: polyline 2: it has one point",
        "annotations.xml: image ../../secret.png: ",
        "annotations.xml: image a.png: images/a.png is 320 x 180, but its labels are for 640 x 180",
    ]
    assert all(word in line for word, line in zip(expected, found, strict=True))


def test_xml_that_declares_entities_is_refused(tmp_path: Path) -> None:
    bomb = '<!DOCTYPE b [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]><annotations>&b;</annotations>'
    (tmp_path / "annotations.xml").write_text(bomb)
    assert "declares entities" in only_fault(tmp_path)
    (tmp_path / "annotations.xml").write_text("<annotations>\n<image>")
    assert "annotations.xml:2: not XML" in only_fault(tmp_path)


def test_a_labeled_frame_after_the_end_of_the_video_is_reported(tmp_path: Path, clip: Path) -> None:
    shutil.copy(clip / "drive.mp4", tmp_path)
    records = [clip_record([], lanes=[], clip="drive.mp4", frame=index) for index in (9, 1, -1)]
    write_lines(tmp_path / "drive.jsonl", *records)
    before, after = faults(tmp_path)
    assert "drive.jsonl:3: drive.mp4#-1: frame -1 is before the first one" in before
    assert "drive.jsonl:1: drive.mp4#9: there is no frame 9: drive.mp4 has 3 frames" in after


def test_bad_tracks_are_reported(tmp_path: Path, clip: Path) -> None:
    track = f'<track id="2">{polyline(LEFT, frame=0)}{polyline(LEFT)}</track>'
    write_cvat(tmp_path / "annotations.xml", track, meta="<source>drive.mp4</source>")
    found = faults(tmp_path)
    assert "annotations.xml: track 2: there is no 'frame'" in found[0]
    assert "annotations.xml: there is no file drive.mp4" in found[1]
    shutil.copy(clip / "drive.mp4", tmp_path)
    size = "<original_size><width>x</width><height>2</height></original_size>"
    write_cvat(tmp_path / "annotations.xml", track, meta=f"<task><source>drive.mp4</source>{size}</task>")
    assert "annotations.xml: invalid literal" in faults(tmp_path)[1]


def test_bad_masks_are_reported(tmp_path: Path, draw: Draw) -> None:
    for name in "abcd":
        draw(f"{name}.jpg")
    write_mask(tmp_path / "a_mask.png", np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH))
    write_mask(tmp_path / "b_mask.png", np.zeros((HEIGHT, WIDTH // 2), np.uint8))
    (tmp_path / "c_mask.png").write_bytes(cv2.imencode(".jpg", road())[1].tobytes())
    write_mask(tmp_path / "d_mask.png", draw_mask(([[10, 100], [90, 100]], 1), ([[10, 150], [20, 90]], 2), thickness=1))
    write_mask(tmp_path / "e_mask.png", draw_mask())
    expected = [
        "a_mask.png: it has 57599 different values",
        "b_mask.png: b.jpg is 320 x 180, but its labels are for 160 x 180",
        "c_mask.png: a mask must be a PNG file",
        "d_mask.png: instance 1: it has one point",
        "e_mask.png: there is no file e.jpg",
    ]
    assert all(word in line for word, line in zip(expected, faults(tmp_path), strict=True))


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.just(10**400),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["points", "flags", "a"]), inner),
    max_leaves=6,
)
_SOUND: dict[str, dict[str, Any]] = {
    "tusimple": tusimple_record("a.jpg", [1, 2, 3]) | {"source": "clips/a/1/2.jpg"},
    "labelme": {
        "shapes": [line_strip(LEFT)],
        "imagePath": "a.jpg",
        "imageWidth": WIDTH,
        "imageHeight": 180,
        "imageData": "",
    },
    "clips": clip_record(clip="b.mp4", image="a.jpg"),
}


def _paths(record: dict[str, Any]) -> list[tuple[str, ...]]:
    """Returns each field, and each field of the first lane."""
    nested = next((key for key in ("lanes", "shapes") if key in record and isinstance(record[key][0], dict)), None)
    return [(key,) for key in record] + [(nested, key) for key in (record[nested][0] if nested else ())]


@settings(derandomize=True, deadline=None, max_examples=100)
@given(data=st.data())
def test_no_record_raises_anything_else(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = tmp_path_factory.mktemp("fuzzed")
    drawer(folder)("a.jpg")
    format_name = data.draw(st.sampled_from(sorted(_SOUND)))
    record = deepcopy(_SOUND[format_name])
    field = data.draw(st.sampled_from(_paths(record)))
    location = record if len(field) == 1 else record[field[0]][0]
    location[field[-1]] = data.draw(_JSON)
    (folder / ("labels.jsonl" if format_name == "clips" else "labels.json")).write_text(json.dumps(record))
    check = check_dataset(folder, format_name)
    assert len(check.faults) + check.contents.groups.total() >= 1
    assert check.contents.lines()


def test_small_steps_back_down_are_dropped() -> None:
    points = np.array([[10.0, 150.0], [20.0, 120.0], [21.0, 120.6], [22.0, 120.0], [30.0, 90.0]])
    assert checked_points(points, WIDTH, HEIGHT).tolist() == [[10, 150], [20, 120], [30, 90]]
