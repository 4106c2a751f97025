"""Labels of every format are written and read back as the exact polylines."""

from __future__ import annotations

import base64
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from labelfiles import (
    HEIGHT,
    LEFT,
    RIGHT,
    WIDTH,
    Draw,
    Points,
    clip_record,
    cvat_image,
    draw_mask,
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
from lanestream_exporter.datasets.caltech import bezier
from lanestream_exporter.datasets.entries import LabelEntry
from lanestream_exporter.datasets.labels import LabeledFrame
from lanestream_exporter.datasets.reading import read_dataset, read_entries


def points(frame: LabeledFrame) -> list[Points]:
    return [lane.points.tolist() for lane in frame.lanes]


def test_tusimple_columns_become_points_and_drives_groups(tmp_path: Path, draw: Draw) -> None:
    draw("clips/0313-1/6040/20.jpg")
    draw("flat.jpg")
    columns = [x for x, _ in reversed(LEFT)]
    lanes = columns, [-2, 230, 290], [-2, -2, 7], [-2, -2, -2]
    first = tusimple_record("clips/0313-1/6040/20.jpg", *lanes)
    write_lines(tmp_path / "label_data_0313.json", first, tusimple_record("flat.jpg"))
    frames = read(tmp_path)
    assert points(frames[0]) == [LEFT, [[290, 170], [230, 130]]]
    assert points(frames[1]) == []
    assert frames[0].group == "tusimple 0313-1"
    assert frames[0].source == "clips/0313-1/6040/20.jpg"
    assert frames[1].group != frames[0].group


def test_tusimple_records_have_a_split_or_not(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    draw("b.jpg")
    write_lines(tmp_path / "labels.json", tusimple_record("a.jpg") | {"split": "val"}, tusimple_record("b.jpg"))
    entries = list(read_entries(tmp_path))
    assert [entry.split for entry in entries if isinstance(entry, LabelEntry)] == ["val", None]


def test_culane_lines_are_cut_at_the_edge_of_the_image(tmp_path: Path, draw: Draw) -> None:
    clip = "driver_23_30frame/05151640_0419.MP4"
    draw(f"{clip}/00000.jpg")
    draw(f"{clip}/00030.jpg")
    outside = "-60 190 -16.98 180"
    text = f"-12.5 175 {' '.join(f'{x} {y}' for x, y in LEFT)} \n{outside}\n"
    (tmp_path / clip / "00000.lines.txt").write_text(text)
    (tmp_path / clip / "00030.lines.txt").write_text("")
    frames = read(tmp_path)
    assert [points(frame) for frame in frames] == [[LEFT], []]
    assert {frame.group for frame in frames} == {clip}
    assert {frame.group for frame in read(tmp_path / clip)} == {clip}  # whichever path leads there


def test_caltech_splines_are_sampled_and_count_from_zero(tmp_path: Path, draw: Draw) -> None:
    draw("cordova1/f00000.png")
    draw("cordova1/f00001.png")
    control = np.array([[41.0, 171.0], [80.0, 140.0], [110.0, 120.0], [131.0, 101.0]])
    line = np.array([[186.5, 101.0], [291.0, 171.0]])
    box = np.array([[10.0, 10.0], [20.0, 20.0]])
    labels = [(control, "spline", "dy", 7), (line, "line", "sw", np.empty(0)), (box, "rect", "y", np.empty(0))]
    write_ccvl(tmp_path / "cordova1" / "labels.ccvl", [("f00000.png", labels), ("f00001.png", [])])
    first, second = read(tmp_path)
    curve, straight = first.lanes
    assert curve.points[0].tolist() == [40.0, 170.0]
    assert curve.points[-1].tolist() == [130.0, 100.0]
    # The midpoint of the cubic curve by De Casteljau.
    middle = np.array([1.0, 3.0, 3.0, 1.0]) / 8.0 @ control - 1.0
    np.testing.assert_allclose(curve.points[50], middle)
    assert (curve.type, curve.color, curve.lane_id) == ("double", "yellow", 7)
    assert straight.points.tolist() == [[290.0, 170.0], [185.5, 100.0]]
    assert (straight.type, straight.color, straight.lane_id) == ("solid", "white", None)
    assert second.lanes == ()
    assert first.group.endswith("/cordova1")


def test_a_quadratic_spline_is_a_parabola() -> None:
    curve = bezier(np.array([[0.0, 0.0], [1.0, 2.0], [4.0, 0.0]]))
    t = np.linspace(0, 1, len(curve))
    np.testing.assert_allclose(curve, np.stack([2 * t + 2 * t**2, 4 * t - 4 * t**2], axis=1), atol=1e-12)
    with pytest.raises(ValueError, match="5 control points"):
        bezier(np.zeros((5, 2)))


def test_labelme_strips_give_kind_color_and_id(tmp_path: Path, draw: Draw) -> None:
    draw("img/monday/a.jpg")
    other = line_strip([[1, 1], [5, 1], [5, 5]], "car", "polygon")
    downwards = line_strip(LEFT[::-1], "dashed white", group_id=3)
    flagged = line_strip(RIGHT, flags={"yellow": True, "solid": False})
    labelme(tmp_path / "ann" / "a.json", "..\\img\\monday\\a.jpg", downwards, other, flagged)
    (frame,) = read(tmp_path)
    assert points(frame) == [LEFT, RIGHT]
    assert (frame.lanes[0].type, frame.lanes[0].color, frame.lanes[0].lane_id) == ("dashed", "white", 3)
    assert (frame.lanes[1].type, frame.lanes[1].color) == (None, "yellow")
    assert frame.group == f"{tmp_path.name}/monday"


def test_labelme_uses_the_image_inside_the_file(tmp_path: Path) -> None:
    data = base64.b64encode(cv2.imencode(".png", road())[1].tobytes()).decode()
    labelme(tmp_path / "a.json", "gone.jpg", line_strip(LEFT), imageData=data)
    ((frame, image),) = read_dataset(tmp_path)
    assert points(frame) == [LEFT]
    np.testing.assert_array_equal(image, road())


def test_cvat_images_give_attributes_and_groups(tmp_path: Path, draw: Draw) -> None:
    draw("images/a.png")
    draw("images/tuesday/b.png")
    attributes = "".join(
        f'<attribute name="{name}">{value}</attribute>'
        for name, value in (("type", "dashed"), ("Colour", "white"), ("position", "+1"), ("id", "5"))
    )
    box = '<box label="car" xtl="1" ytl="1" xbr="9" ybr="9"/>'
    first = cvat_image("a.png", polyline(RIGHT[::-1], attributes), box, polyline(LEFT, label="solid_yellow"))
    write_cvat(tmp_path / "annotations.xml", first, cvat_image("tuesday/b.png"))
    one, two = read(tmp_path)
    assert points(one) == [RIGHT, LEFT]
    right, left = one.lanes
    assert (right.type, right.color, right.position, right.lane_id) == ("dashed", "white", 1, 5)
    assert (left.type, left.color, left.position, left.lane_id) == ("solid", "yellow", None, None)
    assert (one.group, two.group) == ("task monday", f"{tmp_path.name}/tuesday")


TRACKS = (
    f'<track id="2" label="lane">{polyline(LEFT, frame=1, outside=0)}{polyline(LEFT, frame=2, outside=1)}</track>',
    f'<track id="3" label="lane">{polyline(RIGHT, frame=0)}{polyline(RIGHT, frame=1)}</track>',
)
VIDEO_META = (
    "<task><name>drive</name><source>drive.mp4</source>"
    f"<original_size><width>{WIDTH}</width><height>{HEIGHT}</height></original_size></task>"
)


def test_cvat_tracks_are_read_from_exported_images(tmp_path: Path, draw: Draw) -> None:
    for index in range(2):
        draw(f"images/frame_{index:06d}.png")
    write_cvat(tmp_path / "annotations.xml", *TRACKS, meta=VIDEO_META)
    first, second = read(tmp_path)
    assert (points(first), points(second)) == ([RIGHT], [LEFT, RIGHT])
    assert [lane.lane_id for lane in second.lanes] == [2, 3]
    assert first.group == "drive"


def test_cvat_tracks_are_read_from_the_video(tmp_path: Path, clip: Path) -> None:
    shutil.copy(clip / "drive.mp4", tmp_path)
    write_cvat(tmp_path / "annotations.xml", *TRACKS, meta=VIDEO_META)
    assert [frame.source for frame in read(tmp_path)] == ["drive.mp4#0", "drive.mp4#1"]


def test_clip_labels_are_read_with_their_video(clip: Path) -> None:
    written = [json.loads(line) for line in (clip / "drive.jsonl").read_text().splitlines()]
    frames = read(clip)
    assert [frame.source for frame in frames] == ["drive.mp4#0", "drive.mp4#1", "drive.mp4#2"]
    assert {frame.group for frame in frames} == {"drive"}
    for frame, record in zip(frames, written, strict=True):
        assert points(frame) == [lane["points"] for lane in record["lanes"]]
        assert [lane.type for lane in frame.lanes] == [lane["type"] for lane in record["lanes"]]


def test_a_video_is_found_next_to_the_folder_of_its_labels(tmp_path: Path, clip: Path) -> None:
    (tmp_path / "labels").mkdir()
    (tmp_path / "clips").mkdir()
    shutil.copy(clip / "drive.mp4", tmp_path / "clips")
    shutil.copy(clip / "drive.jsonl", tmp_path / "labels")
    assert len(read(tmp_path / "labels" / "drive.jsonl")) == 3
    assert len(read(tmp_path)) == 3


def test_clip_labels_are_read_with_images(tmp_path: Path, draw: Draw) -> None:
    draw("images/7.jpg")
    write_lines(tmp_path / "labels.jsonl", clip_record(image="images/7.jpg", clip="road.mp4", frame=7))
    (frame,) = read(tmp_path)
    (lane,) = frame.lanes
    assert points(frame) == [LEFT]
    assert (lane.lane_id, lane.position, lane.type, lane.color) == (4, -1, "solid", "yellow")
    assert (frame.group, frame.source) == ("road", "road.mp4#7")


def test_a_binary_mask_gives_one_polyline_per_piece(tmp_path: Path, draw: Draw) -> None:
    draw("images/monday/a.jpg")
    write_mask(tmp_path / "masks" / "monday" / "a.png", draw_mask((LEFT, 255), (RIGHT, 255)))
    (frame,) = read(tmp_path)
    assert frame.group == f"{tmp_path.name}/monday"
    lanes = sorted(frame.lanes, key=lambda lane: lane.points[0, 0])
    for lane, line in zip(lanes, (LEFT, RIGHT), strict=True):
        rows = np.arange(105.0, 165.0)
        drawn = np.interp(rows, *np.array(line)[::-1, ::-1].T)
        read_back = np.interp(rows, *lane.points[::-1, ::-1].T)
        np.testing.assert_allclose(read_back, drawn, atol=1.0)


def test_an_instance_mask_keeps_dashes_together(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    mask = draw_mask((LEFT, 1), (RIGHT, 2))
    mask[120:135] = 0
    write_mask(tmp_path / "a_mask.png", mask)
    (frame,) = read(tmp_path)
    assert [lane.lane_id for lane in frame.lanes] == [1, 2]
    for lane in frame.lanes:
        assert lane.points[0, 1] > 135
        assert lane.points[-1, 1] < 120


def test_colors_of_a_mask_are_instances(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    flat = draw_mask((LEFT, 1), (RIGHT, 2))
    write_mask(tmp_path / "a_mask.png", np.array([[0, 0, 0], [0, 0, 200], [90, 0, 200]], np.uint8)[flat])
    assert len(read(tmp_path)[0].lanes) == 2


def test_pieces_that_meet_end_where_they_meet(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    meeting = draw_mask(([[40, 170], [160, 60], [160, 20]], 9), ([[280, 170], [160, 60]], 9))
    write_mask(tmp_path / "a_mask.png", meeting)
    lanes = read(tmp_path)[0].lanes
    assert sorted(round(float(lane.points[0, 0]), -1) for lane in lanes) == [40, 280]
    assert all(60 <= lane.points[-1, 1] <= 75 for lane in lanes)


def test_holes_and_ragged_edges_do_not_cut_a_piece(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    mask = draw_mask()
    mask[20:171, 96:105] = 9
    mask[80:90, 99:101] = 0  # a hole
    mask[60:62, 106] = 9  # a spur that joins from the side, open downwards
    mask[59, 103:107] = 9
    write_mask(tmp_path / "a_mask.png", mask)
    (lane,) = read(tmp_path)[0].lanes
    assert (lane.points[0, 1], lane.points[-1, 1]) == (170, 20)


def test_an_unrecognized_format_must_be_named(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    with pytest.raises(LabelError, match="no labels of a known format"):
        read(tmp_path)
    labelme(tmp_path / "a.json", "a.jpg", line_strip(LEFT))
    (tmp_path / "a.lines.txt").write_text("")
    with pytest.raises(LabelError, match="several formats: culane, labelme"):
        read(tmp_path)
    assert len(read(tmp_path, "labelme")) == 1
    with pytest.raises(LabelError, match="unknown label format 'openlane'"):
        read(tmp_path, "openlane")
    with pytest.raises(LabelError, match="there is nothing at"):
        read(tmp_path / "missing")
    with pytest.raises(LabelError, match=r"no labeled frames of format cvat in"):
        read(tmp_path, "cvat")
