"""Rendered scenes: labels lie on the paint, and the same scene always gives the same frame."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import av
import numpy as np
import pytest

from lanestream_exporter.datasets.labels import WHOLE
from lanestream_exporter.scenes import Drive, render_clip, render_still, sample_clip, sample_scene, write_clip
from lanestream_exporter.scenes.kerbs import Kerb
from lanestream_exporter.scenes.layout import sample_layout
from lanestream_exporter.scenes.lens import Hood, Lens
from lanestream_exporter.scenes.light import Atmosphere, SceneLight
from lanestream_exporter.scenes.markings import Paintwork, ParkingBays, paint_color
from lanestream_exporter.scenes.projection import GroundGrid, PinholeCamera, RoadProjection
from lanestream_exporter.scenes.random_sampler import RandomSampler
from lanestream_exporter.scenes.road import Boundary, Course, Marking, Pose, Road, Taper
from lanestream_exporter.scenes.roadside import Wall
from lanestream_exporter.scenes.scene import STILL_LENGTH, STYLES, Weather, compose_scene, sample_course
from lanestream_exporter.scenes.surface import Dust, RaggedEdge, Surface, SurfaceMaterial
from lanestream_exporter.scenes.surroundings_sampling import sample_queues
from lanestream_exporter.scenes.traffic import Vehicle

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from lanestream_exporter.scenes import Clip, Scene
    from lanestream_exporter.scenes.layout import Layout, RoadStyle
    from lanestream_exporter.scenes.road import EdgeType

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
        kerbs=(),
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
    double = replace(LINE, type="double", width=0.12, gap=0.16)
    scene = replace(plain, road=replace(plain.road, boundaries=(Boundary(1.8, double), Boundary(-1.8, LINE))))
    frame = render_still(scene)
    left = frame.labels.lanes[0]
    assert left.type == "double"
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


@pytest.mark.parametrize("edge", ["edge", "kerb"])
def test_an_unmarked_boundary_is_labeled_as_an_edge_of_its_type(plain: Scene, edge: EdgeType) -> None:
    boundaries = (Boundary(1.8, LINE), Boundary(-1.8, None, edge=edge))
    label = render_still(replace(plain, road=replace(plain.road, boundaries=boundaries))).labels.lanes[1]
    assert (label.kind, label.type, label.color, label.position) == ("road_edge", edge, None, 1)


def green_step(image: NDArray[np.uint8], x: float, y: float) -> float:
    """Returns the column near (x, y) at which the green light crosses the middle between asphalt and grass."""
    columns = np.arange(round(x) - 12, round(x) + 13)
    light = image[round(y), columns, 1].astype(float)
    light = light if light[-1] > light[0] else -light
    return float(np.interp((light[0] + light[-1]) / 2.0, np.maximum.accumulate(light), columns))


def test_labels_of_edges_lie_where_the_asphalt_ends_and_count_as_positions(plain: Scene) -> None:
    edges = (Boundary(3.0, None), Boundary(1.8, LINE), Boundary(-1.8, LINE), Boundary(-3.0, None))
    grass = [SurfaceMaterial(low, high, (0.1, 0.6, 0.2), 1.0) for low, high in ((3.0, 70.0), (-70.0, -3.0))]
    surface = replace(plain.surface, materials=(GRAY, *grass))
    frame = render_still(replace(plain, road=replace(plain.road, boundaries=edges), surface=surface))
    assert [(lane.position, lane.type) for lane in frame.labels.lanes] == [
        (-2, "edge"),
        (-1, "solid"),
        (1, "solid"),
        (2, "edge"),
    ]
    for lane in (frame.labels.lanes[0], frame.labels.lanes[3]):
        inside = lane.points[(np.abs(lane.points[:, 0] - 320) < 290) & (lane.points[:, 1] > 185)]
        assert len(inside) > 8
        assert max(abs(green_step(frame.image, x, y) - x) for x, y in inside) < 1.1


def test_the_label_of_a_ragged_edge_is_its_mean_line(plain: Scene) -> None:
    straight = Road(Course(40.0, (0.0,)), (Boundary(1.8, LINE), Boundary(-1.8, None)), (0.0,))
    materials = (GRAY, SurfaceMaterial(-70.0, -1.8, (0.1, 0.6, 0.2), 1.0))
    offsets = []
    for seed in range(8):
        surface = replace(plain.surface, materials=materials, ragged=(RaggedEdge(-1.8, 0.06, 0.1, seed),))
        frame = render_still(replace(plain, pose=Pose(20.0, 0.0, 0.0), road=straight, surface=surface))
        points = frame.labels.lanes[1].points
        near = points[(points[:, 1] > 190) & (points[:, 1] < 320)]
        scale = near[:, 1] - 150.0  # pixels of a fixed length on the road
        offsets += [(green_step(frame.image, x, y) - x) / size for (x, y), size in zip(near, scale, strict=True)]
    assert np.std(offsets) > 0.02
    assert abs(np.mean(offsets)) < 0.01


def test_the_foot_of_a_kerb_lies_on_its_label_and_its_blocks_alternate(plain: Scene) -> None:
    road = Road(Course(40.0, (0.0,)), (Boundary(1.8, LINE), Boundary(-1.8, None, edge="kerb")), (0.0,))
    scene = replace(plain, pose=Pose(20.0, 0.0, 0.0), road=road)
    kerb = Kerb(-1.8, -1.0, 0.15, 0.2, (0.9, 0.9, 0.9))
    blocks = replace(kerb, other=(0.05, 0.05, 0.05), block=1.0)
    bare, stone, painted = (
        render_still(replace(scene, kerbs=kerbs)).image.astype(int) for kerbs in ((), (kerb,), (blocks,))
    )
    levels = []
    points = render_still(scene).labels.lanes[1].points
    for x, y in points[(points[:, 0] < 630) & (points[:, 1] > 190)]:
        change = np.abs(stone - bare)[round(y), :, 1]
        assert np.argmax(change > 0.5 * change[round(x) + 3]) == pytest.approx(x, abs=1.5)
        levels.append(painted[round(y), round(x) + 3, 1])
    assert max(levels) > 150
    assert min(levels) < 60


def test_a_wall_right_at_an_edge_does_not_hide_its_label(plain: Scene) -> None:
    road = replace(plain.road, boundaries=(Boundary(2.6, None), *plain.road.boundaries))
    wall = Wall("jersey", u=2.6, height=1.0, color=(0.5, 0.5, 0.5))
    free, beside = (render_still(replace(plain, road=road, walls=walls)).labels for walls in ((), (wall,)))
    assert [lane.type for lane in beside.lanes] == [lane.type for lane in free.lanes]
    assert len(beside.lanes[0].points) > 0.8 * len(free.lanes[0].points)


def test_an_edge_behind_parked_vehicles_has_no_label(plain: Scene) -> None:
    road = replace(plain.road, boundaries=(*plain.road.boundaries, Boundary(-3.6, None, edge="kerb")))
    cars = tuple(
        Vehicle("van", s=20.5 + 5.2 * n, u=-2.8, speed=0.0, length=5.0, width=1.9, height=2.0, color=(0.1, 0.1, 0.6))
        for n in range(20)
    )
    free, parked = (render_still(replace(plain, road=road, traffic=traffic)).labels for traffic in ((), cars))
    assert [lane.type for lane in free.lanes] == ["solid", "solid", "kerb"]
    assert [lane.type for lane in parked.lanes] == ["solid", "solid"]


def test_dust_hides_the_paint_beside_the_edge_only(plain: Scene) -> None:
    dust = Dust(-2.0, 1.0, 1.0, (0.3, 0.37, 0.5), 0.9, seed=1)
    clean, dusty = (
        render_still(replace(plain, surface=replace(plain.surface, dust=films))).image.astype(int)
        for films in ((), (dust,))
    )
    left, right = render_still(plain).labels.lanes
    for lane, changes in ((left, False), (right, True)):
        x, y = np.round(lane.points[2]).astype(int)
        assert (np.abs(clean[y, x] - dusty[y, x]).max() > 40) == changes


def test_faded_yellow_paint_is_nearly_white() -> None:
    yellow = replace(LINE, color="yellow")
    fresh, old = paint_color(yellow), paint_color(replace(yellow, fade=1.0))
    assert fresh[0] < 0.4 * fresh[2]
    assert 0.75 * old[2] < old[0] < old[1] < old[2]


def test_lines_between_parking_bays_are_painted_and_not_labeled(plain: Scene) -> None:
    bays = ParkingBays(-1.5, 1.5, 2.5, 0.3, (0.9, 0.9, 0.9), 0.0, 1)
    before, after = (render_still(replace(plain, paintwork=Paintwork(bays=painted))) for painted in ((), (bays,)))
    assert (after.image.astype(int) - before.image)[200:, 320].max() > 60
    assert len(after.labels.lanes) == 2


def sampled(style: RoadStyle, count: int) -> list[Layout]:
    """Returns cross-sections of a style."""
    sampler = RandomSampler(np.random.default_rng(5))
    return [sample_layout(sampler, style) for _ in range(count)]


@pytest.mark.parametrize("style", STYLES)
def test_edges_are_the_outermost_boundaries_at_the_limits_of_the_pavement(style: RoadStyle) -> None:
    for layout in sampled(style, 60):
        places = [boundary.u for boundary in layout.boundaries]
        assert places == sorted(set(places), reverse=True)
        edges = [(boundary.u, boundary.edge) for boundary in layout.boundaries if not boundary.marking]
        limits = zip(layout.paved[::-1], layout.edges[::-1], strict=True)
        assert edges == [(u, edge) for u, edge in limits if edge]
        if style == "highway":
            assert all(0.3 <= abs(places[end] - places[end + step]) <= 3.6 for end, step in ((0, 1), (-1, -1)))


def test_roads_on_a_campus_have_no_markings_and_squares_no_boundaries() -> None:
    campus = sampled("campus", 200)
    assert not any(layout.markings for layout in campus)
    widths = [left - right for right, left in (layout.paved for layout in campus if None not in layout.edges)]
    assert 4.0 <= min(widths) < 4.5
    assert 8.5 < max(widths) <= 9.0
    assert 0.5 < np.mean(["kerb" in layout.edges for layout in campus]) < 0.95
    assert not any(layout.boundaries for layout in sampled("square", 20))


def test_a_frame_of_a_square_has_no_labels() -> None:
    sampler = RandomSampler(np.random.default_rng(2))
    for _ in range(3):
        scene = compose_scene(sampler, (320, 180), "square", Weather(False, False, False, math.inf), STILL_LENGTH)
        assert render_still(scene).labels.lanes == ()


def test_dots_are_labeled_as_dots() -> None:
    types = {boundary.type for layout in sampled("highway", 40) for boundary in layout.boundaries}
    assert types <= {"solid", "dashed", "double", "dots", "edge", "kerb"}
    assert {"dots", "edge", "kerb"} <= types


@pytest.mark.parametrize("horizon", [-120.0, -40.0, 10.0])
def test_a_camera_that_looks_down_sees_and_labels_the_road(plain: Scene, horizon: float) -> None:
    frame = render_still(replace(plain, camera=PinholeCamera(640, 394, 60.0, 2.2, horizon)))
    assert frame.labels.horizon == frame.horizon == horizon
    assert [lane.position for lane in frame.labels.lanes] == [-1, 1]
    for lane in frame.labels.lanes:
        assert lane.points[-1, 1] <= max(5.0, horizon + 35.0)
        inside = lane.points[(np.abs(lane.points[:, 0] - 320) < 250) & (lane.points[:, 1] > horizon + 40.0)]
        assert len(inside) > 20
        assert max(abs(paint_center(frame.image, x, y, 60) - x) for x, y in inside) < 0.6


def test_some_cameras_look_down_and_some_are_near_the_ground() -> None:
    cameras = [sample_scene(np.random.default_rng(seed), 320, 180).camera for seed in range(300)]
    shares = np.array([camera.horizon / camera.height for camera in cameras])
    heights = np.array([camera.mount_height for camera in cameras])
    down = shares < 0.06
    assert 0.08 < down.mean() < 0.17
    assert -0.36 < shares.min() < -0.25
    assert (heights[down] >= 1.8).all()
    assert 0.04 < (heights < 0.9).mean() < 0.12


def test_what_a_branch_draws_does_not_change_its_sampler() -> None:
    first, second = (RandomSampler(np.random.default_rng(1)) for _ in range(2))
    drawn = [first.branch().seed() for _ in range(2)]
    assert drawn == [second.branch().seed() for _ in range(2)]
    assert drawn[0] != drawn[1]
    assert first.seed() == RandomSampler(np.random.default_rng(1)).seed()


def test_standing_traffic_leaves_gaps_of_two_to_six_meters() -> None:
    queues = sample_queues(RandomSampler(np.random.default_rng(0)), (0.0, 3.5), 20.0, 260.0)
    for lane in (0.0, 3.5):
        cars = [car for car in queues if abs(car.u - lane) < 1.0]
        gaps = [after.s - car.s - car.length for car, after in pairwise(cars)]
        assert len(gaps) > 4
        assert all(2.0 <= gap <= 6.0 for gap in gaps)


def samples(count: int) -> list[Scene]:
    """Returns sampled scenes."""
    return [sample_scene(np.random.default_rng(seed), 320, 180) for seed in range(count)]


def test_sampled_scenes_have_all_scenery() -> None:
    scenes = samples(400)
    kerbs = [kerb for scene in scenes for kerb in scene.kerbs]
    assert 0.08 <= min(kerb.height for kerb in kerbs) < max(kerb.height for kerb in kerbs) <= 0.2
    assert 0.1 < np.mean([kerb.other is not None for kerb in kerbs]) < 0.35
    for parts in (
        [scene.surface.dust for scene in scenes],
        [scene.surface.ragged for scene in scenes],
        [scene.paintwork.bays for scene in scenes],
        [[bars for bars in scene.paintwork.bars if bars.yellow] for scene in scenes],  # speed bumps
        [[wall for wall in scene.walls if wall.u in {b.u for b in scene.road.boundaries}] for scene in scenes],
        [[seam for seam in scene.surface.seams if seam.width == 0.07] for scene in scenes],  # rails
        [
            [boundary for boundary in scene.road.boundaries if boundary.marking and boundary.marking.fade]
            for scene in scenes
        ],
    ):
        assert 0.005 < np.mean([bool(part) for part in parts]) < 0.9


def test_kerbs_stand_at_the_boundaries_that_are_labeled_as_kerbs() -> None:
    for scene in samples(60):
        feet = {boundary.u for boundary in scene.road.boundaries if boundary.type == "kerb"}
        assert {kerb.u for kerb in scene.kerbs} == feet


def test_an_edge_without_a_kerb_can_be_told_from_what_lies_beyond() -> None:
    for scene in samples(100):
        for boundary in scene.road.boundaries:
            if boundary.type == "edge":
                colors = [
                    next(m for m in reversed(scene.surface.materials) if m.low <= boundary.u + side < m.high).color
                    for side in (0.02, -0.02)
                ]
                assert max(abs(a - b) for a, b in zip(*colors, strict=True)) > 0.09


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
    assert -0.36 * size[1] < frame.horizon < 0.7 * size[1]


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
    assert all(before[key].type == after[key].type and before[key].color == after[key].color for key in shared)
    assert any(before[key].position != after[key].position for key in shared)


def test_paint_moves_with_the_road(plain: Scene) -> None:
    dashed = replace(LINE, type="dashed", period=10.0, dash=4.0)
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
