"""Rendered scenes: labels lie on the paint, and the same scene always gives the same frame."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import av
import numpy as np
import pytest

from lanestream_exporter.datasets.labels import WHOLE
from lanestream_exporter.scenes import Drive, render_clip, render_still, sample_clip, sample_scene, write_clip
from lanestream_exporter.scenes.lens import Hood, Lens
from lanestream_exporter.scenes.light import Atmosphere, SceneLight
from lanestream_exporter.scenes.markings import Paintwork
from lanestream_exporter.scenes.projection import GroundGrid, PinholeCamera, RoadProjection
from lanestream_exporter.scenes.random_sampler import RandomSampler
from lanestream_exporter.scenes.road import Boundary, Course, Marking, Pose, Road, Taper
from lanestream_exporter.scenes.roadside import Wall
from lanestream_exporter.scenes.scene import sample_course
from lanestream_exporter.scenes.surface import Surface, SurfaceMaterial
from lanestream_exporter.scenes.traffic import Vehicle

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from lanestream_exporter.scenes import Clip, Scene
    from lanestream_exporter.scenes.layout import RoadStyle

LINE = Marking("solid", "white", width=0.3, brightness=0.95, wear=0.0)
GRAY = SurfaceMaterial(-70.0, 70.0, (0.3, 0.3, 0.3), 1.0)


@pytest.fixture
def plain() -> Scene:
    """Returns an empty, evenly lit road curving left with one bright line on either side."""
    scene = sample_scene(np.random.default_rng(7), 640, 360)
    return replace(
        scene,
        camera=PinholeCamera(640, 360, 60.0, 1.4, 150.0),
        pose=Pose(20.0, 0.3, 0.02),
        road=Road(Course(40.0, (0.002, 0.003, 0.001, 0.0)), (Boundary(1.8, LINE), Boundary(-1.8, LINE)), (0.0,)),
        surface=Surface((GRAY,), grain=0.0, mottle=0.0, streaks=0.0),
        paintwork=Paintwork(),
        light=SceneLight((0.4, 0.4, 0.4)),
        atmosphere=Atmosphere((0.8, 0.8, 0.8), 1e6),
        lens=Lens(),
        walls=(),
        items=(),
        bridges=(),
        traffic=(),
        wetness=0.0,
    )


def paint_center(image: NDArray[np.uint8], x: float, y: float, reach: int) -> float:
    """Returns the centroid of the light that stands out from the gray road around (x, y), in pixels."""
    columns = np.arange(max(0, round(x) - reach), min(image.shape[1], round(x) + reach + 1))
    light = image[round(y), columns, 1].astype(float)
    light -= light.min()
    assert light.max() > 20.0, f"no paint near ({x:.1f}, {y:.1f})"
    return float((columns * light).sum() / light.sum())


@pytest.mark.parametrize("vertical_curvature", [0.0, 3e-4, -3e-4])
def test_labels_lie_on_the_center_of_the_paint(plain: Scene, vertical_curvature: float) -> None:
    course = replace(plain.road.course, vertical_curvature=vertical_curvature)
    scene = replace(plain, road=replace(plain.road, course=course))
    frame = render_still(scene)
    assert [lane.position for lane in frame.labels.lanes] == [-1, 1]
    for lane in frame.labels.lanes:
        inside = lane.points[(np.abs(lane.points[:, 0] - 320) < 280) & (lane.points[:, 1] > 175)]
        assert len(inside) > 20
        errors = [paint_center(frame.image, x, y, max(8, int(0.4 * (y - 150)))) - x for x, y in inside]
        assert np.abs(errors).max() < 0.5


def test_labels_of_a_tapered_boundary_lie_on_its_paint_and_end_with_it(plain: Scene) -> None:
    taper = Taper(start=30.0, length=25.0, shift=1.5)
    tapered = Boundary(-3.5, LINE, taper, last=50.0)
    road = replace(plain.road, boundaries=(Boundary(1.8, LINE), tapered))
    frame = render_still(replace(plain, road=road))
    points = frame.labels.lanes[1].points
    farthest = render_still(replace(plain, road=replace(road, boundaries=(road.boundaries[0], Boundary(-3.5, LINE)))))
    assert points[-1, 1] > farthest.labels.lanes[1].points[-1, 1] + 15.0
    inside = points[(points[:, 0] < 600) & (points[:, 1] > points[-1, 1] + 2.0)]
    assert len(inside) > 8
    errors = [paint_center(frame.image, x, y, max(8, int(0.4 * (y - 150)))) - x for x, y in inside]
    assert np.abs(errors).max() < 0.6


def test_a_boundary_that_has_ended_or_not_begun_has_no_position() -> None:
    boundaries = (Boundary(1.8, LINE), Boundary(-1.8, LINE, last=40.0), Boundary(-5.4, LINE, first=30.0))
    road = Road(Course(40.0, (0.0,)), boundaries, (0.0, -3.6))
    assert road.positions(20.0, 0.0) == (-1, 1, None)
    assert road.positions(35.0, 0.0) == (-1, 1, 2)
    assert road.positions(45.0, 0.0) == (-1, None, 1)


def test_labels_of_double_lines_lie_between_the_stripes(plain: Scene) -> None:
    double = replace(LINE, kind="double", width=0.12, gap=0.16)
    scene = replace(plain, road=replace(plain.road, boundaries=(Boundary(1.8, double), Boundary(-1.8, LINE))))
    frame = render_still(scene)
    left = frame.labels.lanes[0]
    assert left.kind == "double"
    near = left.points[left.points[:, 1] > 250]
    near = near[near[:, 0] > 30]
    for x, y in near:
        assert abs(paint_center(frame.image, x, y, 40) - x) < 0.7
        assert frame.image[round(y), round(x), 1] < 120


def test_road_coordinates_invert_the_projection(plain: Scene) -> None:
    grid = GroundGrid.from_projection(RoadProjection.from_pose(plain.camera, plain.road.course, plain.pose))
    rows = np.arange(200.0, 360.0, 10.0)
    for u in (-1.5, 0.0, 2.5):
        columns = grid.projection.boundary_columns(rows, u)
        for column, row in zip(columns, rows, strict=True):
            if 0 <= column < 638:
                across = grid.u[int(row) - grid.top]
                found = np.interp(column, [int(column), int(column) + 1], across[int(column) : int(column) + 2])
                assert found == pytest.approx(u, abs=1e-3)


def test_an_unmarked_road_edge_is_labeled_as_edge(plain: Scene) -> None:
    scene = replace(plain, road=replace(plain.road, boundaries=(Boundary(1.8, LINE), Boundary(-1.8, None))))
    edge = render_still(scene).labels.lanes[1]
    assert (edge.kind, edge.color, edge.position) == ("edge", None, 1)


def test_labels_stay_above_the_hood(plain: Scene) -> None:
    hood = Hood(height=0.15, droop=0.0, color=(0.1, 0.1, 0.1), shine=0.0)
    lanes = render_still(replace(plain, lens=Lens(hood=hood))).labels.lanes
    assert max(lane.points[:, 1].max() for lane in lanes) < 0.85 * 360


def test_labels_run_through_vehicles(plain: Scene) -> None:
    car = Vehicle("car", s=34.0, u=1.8, speed=0.0, length=4.5, width=1.8, height=1.5, color=(0.1, 0.1, 0.6))
    free, covered = render_still(plain), render_still(replace(plain, traffic=(car,)))
    assert np.abs(free.image.astype(int) - covered.image).max() > 60
    for before, after in zip(free.labels.lanes, covered.labels.lanes, strict=True):
        assert np.array_equal(before.points, after.points)


def test_positions_count_outward_from_the_vehicle() -> None:
    road = Road(Course(40.0, (0.0,)), tuple(Boundary(u, LINE) for u in (5.4, 1.8, -1.8, -5.4)), (3.6, 0.0, -3.6))
    assert road.positions(20.0, 0.0) == (-2, -1, 1, 2)
    assert road.positions(20.0, 3.0) == (-1, 1, 2, 3)
    assert road.positions(20.0, -6.0) == (-4, -3, -2, -1)


def test_labels_end_where_a_wall_hides_the_road(plain: Scene) -> None:
    curved_road = replace(plain.road, course=Course(40.0, (0.012, 0.012, 0.012)))
    open_view = render_still(replace(plain, road=curved_road)).labels
    wall = Wall("jersey", u=2.6, height=1.8, color=(0.5, 0.5, 0.5))
    hidden = render_still(replace(plain, road=curved_road, walls=(wall,))).labels
    assert hidden.lanes[0].points[:, 1].min() > open_view.lanes[0].points[:, 1].min() + 2.0


@pytest.mark.parametrize("seed", range(12))
def test_sampled_labels_are_inside_the_image_ordered_and_complete(seed: int) -> None:
    frame = render_still(sample_scene(np.random.default_rng(seed), 320, 180))
    assert frame.image.shape == (180, 320, 3)
    assert frame.image.dtype == np.uint8
    assert frame.labels.coverage == WHOLE
    for lane in frame.labels.lanes:
        x, y = lane.points.T
        assert (x >= 0).all()
        assert (x <= 319).all()
        assert (np.diff(y) < 0).all()
        assert lane.position != 0
        assert lane.lane_id is not None
    positions = [lane.position or 0 for lane in frame.labels.lanes]
    assert positions == sorted(set(positions))


def test_curve_radii_match_the_road_style() -> None:
    sampler = RandomSampler(np.random.default_rng(3))

    def radii(style: RoadStyle) -> NDArray[np.float64]:
        courses = [sample_course(sampler, style, 260.0) for _ in range(100)]
        return 1.0 / np.maximum([np.abs(course.curvatures).max() for course in courses], 1e-9)

    country, highway = radii("country"), radii("highway")
    assert 30.0 <= country.min() < 40.0
    assert 40.0 < np.median(country) < 120.0
    assert 250.0 <= highway.min() < 350.0
    assert country.max() > 10_000.0  # straight


def test_equal_seeds_give_equal_frames_and_different_seeds_different_ones() -> None:
    first, second, other = (render_still(sample_scene(np.random.default_rng(seed), 320, 180)) for seed in (3, 3, 4))
    assert np.array_equal(first.image, second.image)
    assert not np.array_equal(first.image, other.image)


@pytest.mark.parametrize("size", [(320, 180), (321, 241), (640, 480), (500, 190), (360, 640)])
def test_any_size_and_aspect_renders(size: tuple[int, int]) -> None:
    frame = render_still(sample_scene(np.random.default_rng(11), *size))
    assert frame.image.shape == (size[1], size[0], 3)
    assert 0.25 * size[1] < frame.horizon < 0.7 * size[1]


@pytest.fixture
def lane_change() -> Clip:
    """Returns ten seconds of highway at one frame per second, with a lane change."""
    for seed in range(20):
        clip = sample_clip(
            np.random.default_rng(seed), 320, 180, 10, 1.0, Drive("highway", lane_change=True, fair=True)
        )
        if clip.motion.moves:
            return clip
    raise AssertionError("none of 20 sampled highways has two lanes")


def test_a_lane_change_shifts_positions_and_keeps_ids(lane_change: Clip) -> None:
    first, *_, last = render_clip(lane_change)
    before, after = ({lane.lane_id: lane for lane in frame.labels.lanes} for frame in (first, last))
    shared = before.keys() & after.keys()
    assert shared
    assert all(before[key].kind == after[key].kind and before[key].color == after[key].color for key in shared)
    assert any(before[key].position != after[key].position for key in shared)


def test_paint_moves_with_the_road(plain: Scene) -> None:
    dashed = replace(LINE, kind="dashed", period=10.0, dash=4.0)
    road = replace(plain.road, course=Course(40.0, (0.0,)), boundaries=(Boundary(1.8, dashed), Boundary(-1.8, dashed)))
    first = replace(plain, road=road, pose=Pose(20.0, 0.0, 0.0))
    frames = [render_still(replace(first, pose=Pose(20.0 + distance, 0.0, 0.0))).image for distance in (0.0, 5.0, 10.0)]
    difference = np.abs(frames[0].astype(int) - frames[1]), np.abs(frames[0].astype(int) - frames[2])
    assert difference[0].max() > 80
    assert difference[1].max() <= 4  # moved by exactly one period, up to rounding


def test_timestamps_follow_the_frame_rate(lane_change: Clip) -> None:
    clip = replace(lane_change, frames=3, fps=20.0)
    assert [frame.timestamp for frame in render_clip(clip)] == pytest.approx([0.0, 0.05, 0.1])


def test_a_written_clip_has_one_label_line_per_frame(lane_change: Clip, tmp_path: Path) -> None:
    clip = replace(lane_change, frames=5, fps=20.0)
    progress: list[int] = []
    video, labels = tmp_path / "drive.mp4", tmp_path / "drive.jsonl"
    write_clip(clip, video, labels, progress.append)
    with av.open(str(video)) as container:
        images = [decoded.to_ndarray(format="bgr24") for decoded in container.decode(video=0)]
    assert [image.shape for image in images] == [(180, 320, 3)] * 5
    rendered = next(render_clip(clip)).image
    assert np.abs(images[0].astype(int) - rendered).mean() < 6.0
    records = [json.loads(line) for line in labels.read_text().splitlines()]
    assert [record["frame"] for record in records] == list(range(5))
    assert {record["clip"] for record in records} == {"drive.mp4"}
    assert set(records[0]) == {"clip", "frame", "width", "height", "lanes"}
    assert set(records[0]["lanes"][0]) == {"id", "position", "type", "color", "points"}
    assert progress == [1, 2, 3, 4, 5]


def test_video_with_odd_sizes_is_rejected(tmp_path: Path) -> None:
    clip = sample_clip(np.random.default_rng(0), 321, 180, 1, 20.0)
    with pytest.raises(ValueError, match="even width and height, got 321x180"):
        write_clip(clip, tmp_path / "odd.mp4", tmp_path / "odd.jsonl")
