"""Boundaries that were drawn as polygons and points become lines, and those of other tools are refused."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labelfiles import (
    LEFT,
    RIGHT,
    WIDTH,
    Draw,
    Points,
    check_dataset,
    cvat_image,
    faults,
    labelme,
    line_strip,
    polyline,
    read,
    write_cvat,
)

from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.label_map import BY_WORDS, words_of
from lanestream_exporter.datasets.shapes import center_line

# The outline of a marking along LEFT, which is 8 pixels wide at its lower and 4 at its upper end.
OUTLINE = [[36.0, 170.0], [44.0, 170.0], [93.5, 130.0], [132.25, 100.0], [128.25, 100.0], [87.5, 130.0]]


def cvat_shape(tag: str, points: Points, label: str = "lane", **attributes: Any) -> str:
    return polyline(points, label=label, **attributes).replace("polyline", tag)


def skeleton(points: Points) -> str:
    parts = "".join(f'<points label="{number}" points="{x},{y}"/>' for number, (x, y) in enumerate(points))
    return f'<skeleton label="lane">{parts}</skeleton>'


def read_points(path: Path) -> list[Points]:
    (frame,) = read(path)
    return [lane.points.tolist() for lane in frame.lanes]


def test_the_line_of_an_outline_is_midway_between_its_sides() -> None:
    for turned in range(len(OUTLINE)):
        outline = np.roll(np.array(OUTLINE), turned, axis=0)
        assert center_line(outline, WIDTH).tolist() == LEFT
        assert center_line(outline[::-1], WIDTH).tolist() == LEFT


def test_ends_that_are_cut_off_at_an_angle_are_left_out() -> None:
    outline = np.array([[36.0, 170.0], [44.0, 172.0], [93.5, 130.0], [132.25, 100.0], [128.25, 99.0], [87.5, 130.0]])
    line = center_line(outline, WIDTH)
    np.testing.assert_allclose(line[[0, -1], 0], [41.2, 130.2], atol=1.0)
    assert (line[0, 1], line[-1, 1]) == (170.0, 100.0)


def test_an_outline_may_taper_to_a_point() -> None:
    assert center_line(np.array([[36.0, 170.0], [44.0, 170.0], [140.0, 90.0]])).tolist() == [[40, 170], [140, 90]]


def test_a_dense_outline_gives_the_line_that_it_surrounds() -> None:
    rows = np.linspace(170.0, 60.0, 60)
    center = 160.0 + (rows - 60.0) ** 2 / 150.0
    sides = [np.stack([center + side * (rows - 50.0) / 20.0, rows], axis=1) for side in (-1, 1)]
    line = center_line(np.concatenate([sides[0], sides[1][::-1]]), WIDTH)
    np.testing.assert_allclose(np.interp(rows, line[::-1, 1], line[::-1, 0]), center, atol=0.1)


@pytest.mark.parametrize("direction", [1, -1])
def test_a_polygon_that_goes_one_way_was_meant_as_a_line(direction: int) -> None:
    drawn: FloatArray = np.array([[40.0, 170.0], [90.0, 120.0], [110.0, 90.0], [118.0, 60.0]])[::direction]
    assert sorted(center_line(drawn).tolist()) == sorted(drawn.tolist())


@pytest.mark.parametrize(
    "shapes",
    [
        [cvat_shape("polygon", OUTLINE)],
        [cvat_shape("points", [LEFT[1], LEFT[0], LEFT[2]])],
        [skeleton([LEFT[1], LEFT[0], LEFT[2]])],
        [cvat_shape("points", [point]) for point in LEFT],
        [cvat_shape("points", [point], group_id=4) for point in LEFT],
        [cvat_shape("polygon", LEFT[:2], group_id=4), cvat_shape("points", LEFT[2:], group_id=4)],
    ],
)
def test_cvat_shapes_become_lines(tmp_path: Path, draw: Draw, shapes: list[str]) -> None:
    draw("a.png")
    write_cvat(tmp_path / "annotations.xml", cvat_image("a.png", *shapes))
    assert read_points(tmp_path) == [LEFT]


def test_cvat_tracks_of_polygons_become_lines(tmp_path: Path, clip: Path) -> None:
    shutil.copy(clip / "drive.mp4", tmp_path)
    tracks = [
        f'<track id="5" label="lane">{cvat_shape("polygon", OUTLINE, frame=1)}</track>',
        f'<track id="6" label="kerb">{cvat_shape("points", RIGHT, frame=1)}</track>',
    ]
    write_cvat(tmp_path / "annotations.xml", *tracks, meta="<source>drive.mp4</source>")
    (frame,) = read(tmp_path)
    assert [(lane.lane_id, lane.type, lane.points.tolist()) for lane in frame.lanes] == [
        (5, None, LEFT),
        (6, "kerb", RIGHT),
    ]


@pytest.mark.parametrize(
    "shapes",
    [
        [line_strip(OUTLINE, "dashed_white", "polygon", group_id=2)],
        [line_strip(OUTLINE, "DashedWhite", None, group_id=2)],  # type: ignore[arg-type]
        [line_strip([point], "dashed white", "point", group_id=2) for point in LEFT],
        [line_strip(LEFT[::-1], "dashed white", "points", group_id=2)],
        [line_strip(LEFT, "dashed white", "linestrip", group_id=2)],
    ],
)
def test_labelme_shapes_become_lines(tmp_path: Path, draw: Draw, shapes: list[dict[str, Any]]) -> None:
    draw("a.jpg")
    labelme(tmp_path / "a.json", "a.jpg", *shapes)
    (frame,) = read(tmp_path)
    assert [(lane.type, lane.color, lane.lane_id) for lane in frame.lanes] == [("dashed", "white", 2)]
    assert frame.lanes[0].points.tolist() == LEFT


def test_points_with_two_labels_are_two_boundaries(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    points = [(point, "lane 1") for point in LEFT] + [(point, "lane 2") for point in RIGHT]
    labelme(tmp_path / "a.json", "a.jpg", *(line_strip([point], label, "point") for point, label in points))
    assert read_points(tmp_path) == [LEFT, RIGHT]


def test_what_was_converted_and_what_was_ignored_is_counted(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    shapes = line_strip(OUTLINE, kind="polygon"), line_strip(OUTLINE, "car", "polygon"), line_strip(RIGHT)
    labelme(tmp_path / "a.json", "a.jpg", *shapes)
    lines = check_dataset(tmp_path).contents.lines()
    assert "converted shapes: polygon: 1" in lines
    assert "ignored shapes: polygon 'car': 1" in lines


SQUARE = [[40.0, 90.0], [200.0, 90.0], [240.0, 170.0], [10.0, 170.0]]


@pytest.mark.parametrize(
    ("shapes", "expected"),
    [
        ([line_strip(SQUARE, kind="polygon")], "shape 1 'lane': this polygon is 1"),
        (
            [line_strip(SQUARE[::2], kind="rectangle")],
            "labeled 'lane', but the tool rectangle of LabelMe draws no line",
        ),
        ([line_strip(SQUARE[:2], kind="circle")], "the tool circle of LabelMe draws no line"),
        ([line_strip(SQUARE[:2], kind="mask")], "the tool mask of LabelMe draws no line"),
        ([line_strip([point], kind="point") for point in LEFT + RIGHT], "give each boundary a group"),
        ([line_strip(LEFT[:1], kind="point")], "shape 1: it has one point; at least two are needed"),
        ([line_strip([[1, float("nan")], [2, 2], [3, 3]], kind="polygon")], "one of its points is not a number"),
        ([line_strip([[1, 9], [2, 9], [3, 9]], kind="polygon")], "its points all lie on row 9"),
        ([line_strip(OUTLINE, "tree", "polygon")], "is taken for a lane boundary: polygon 'tree' (1)"),
        ([line_strip(OUTLINE, "1", "polygon")], "if their label has a word like lane"),
        ([line_strip(SQUARE, "lane_area", "polygon")], "is taken for a lane boundary: polygon 'lane_area' (1)"),
    ],
)
def test_what_can_not_be_converted_is_reported(
    tmp_path: Path, draw: Draw, shapes: list[dict[str, Any]], expected: str
) -> None:
    draw("a.jpg")
    labelme(tmp_path / "a.json", "a.jpg", *shapes)
    (fault,) = faults(tmp_path)
    assert expected in fault


@pytest.mark.parametrize("tag", ["box", "ellipse", "mask", "cuboid"])
def test_cvat_tools_that_draw_no_line_are_named(tmp_path: Path, draw: Draw, tag: str) -> None:
    draw("a.png")
    write_cvat(tmp_path / "annotations.xml", cvat_image("a.png", polyline(RIGHT), f'<{tag} label="lane line"/>'))
    (fault,) = faults(tmp_path)
    assert f"image a.png: {tag} 1 is labeled 'lane line', but the tool {tag} of CVAT draws no line" in fault


def test_labels_that_name_boundaries() -> None:
    named = (
        "lane",
        "Lane_1",
        "laneLine",
        "left line",
        "SolidWhite",
        "road marking",
        "kerb",
        "curb",
        "road edge",
        "DASHED",
    )
    assert {BY_WORDS.meaning(label) for label in named} == {"lane"}
    others = "car", "plane", "airline", "drivable area", "lane area", "stop line", "crosswalk", "1", "", "white van"
    assert "lane" not in map(BY_WORDS.meaning, others)
    assert words_of("Solid_white-lane2") == ["solid", "white", "lane"]
