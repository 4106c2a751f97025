"""Boundaries in meters, against points of the road that are projected exactly."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Final

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanestream.messages import ProcessedFrame, lanes_message
from lanestream.road.camera import Camera, Distortion, Lens, camera_from_vehicle
from lanestream.road.curve import Curve, FloatArray, curve_basis
from lanestream.road.ground import with_meters
from lanestream.road.results import EgoLane, EgoMeters, Estimate, FrameResult, LaneBoundary, RoadEstimate

SIZE: Final = (1280, 720)
EXACT: Final = Estimate(0.0, 0.0)
WIDE: Final[Distortion] = (-0.28, 0.09, 0.0006, -0.0008, -0.012)
FOCAL: Final = 1100.0

Ground = tuple[float, float, float]


def project(camera: Camera, pitch: float, yaw: float, forward: FloatArray, left: FloatArray) -> FloatArray:
    """Returns the pixels (N, 2) of points of the road; the angles are the camera's in degrees."""
    rotation = camera_from_vehicle(math.radians(pitch), math.radians(yaw), math.radians(camera.roll))
    x, y, z = rotation @ np.stack([forward, left - camera.lateral, np.full_like(forward, -camera.height)])
    return camera.lens(SIZE, SIZE).pixels(np.stack([x / z, y / z], axis=-1))


def result_of(
    camera: Camera, sides: dict[int, Ground], *, pitch: float = 2.0, yaw: float = 0.0, sigma: float = 1.0
) -> FrameResult:
    """Returns what a perfect tracker reports of a road with the boundaries `sides` by track id: 1 left, 2 right."""
    a, b, _ = next(iter(sides.values()))
    column, horizon = project(camera, pitch, yaw, np.array([1e7]), np.array([1e7 * b]))[0].tolist()
    lanes = []
    for track, (a, b, c) in sides.items():
        forward = np.linspace(4.0, 60.0, 200)
        pixels = project(camera, pitch, yaw, forward, a * forward**2 + b * forward + c)
        inside = (pixels >= 0.0).all(axis=1) & (pixels <= np.array(SIZE) - 1.0).all(axis=1)
        columns, rows = pixels[inside].T
        coefficients = np.linalg.lstsq(curve_basis(horizon, rows), columns, rcond=None)[0].tolist()
        covariance = sigma**2 * np.diag([4.0, 1e-5, 1e4])
        lanes.append(
            LaneBoundary(
                track,
                -1 if track == 1 else 1,
                "detected",
                0.9,
                Curve(horizon, tuple(coefficients)),
                covariance,
                float(rows.min()),
                float(rows.max()),
                1.0,
            )
        )
    curvature = float(np.mean([lane.curve.coefficients[2] for lane in lanes]))
    road = RoadEstimate(Estimate(column, 2.0 * sigma), Estimate(curvature, 100.0 * sigma), Estimate(0.25, 0.05))
    ego = EgoLane(1 if 1 in sides else None, 2 if 2 in sides else None)
    return FrameResult(tuple(lanes), ego, horizon, road=road)


def in_meters(result: FrameResult, camera: Camera, yaw: Estimate = EXACT) -> FrameResult:
    return with_meters(result, camera, camera.lens(SIZE, SIZE), yaw, SIZE[1] - 1.0)


def ego_of(result: FrameResult) -> EgoMeters:
    assert result.ego.meters is not None
    return result.ego.meters


def values(meters: EgoMeters) -> dict[str, float]:
    """Returns the values that are known; the heading in degrees."""
    known = {name: estimate.value for name, estimate in vars(meters).items() if estimate is not None}
    return known | {"heading": math.degrees(known["heading"])}


@given(
    height=st.floats(0.5, 3.0),
    a=st.floats(-1.5e-3, 1.5e-3),
    b=st.floats(-0.1, 0.1),
    left=st.floats(1.0, 3.0),
    right=st.floats(-3.0, -1.0),
)
def test_ground_parabolas_are_recovered_exactly_by_a_level_camera(
    height: float, a: float, b: float, left: float, right: float
) -> None:
    camera = Camera(height, 62.0)
    result = in_meters(result_of(camera, {1: (a, b, left), 2: (a, b, right)}, pitch=0.0), camera)
    assert result.lanes[0].ground == pytest.approx((a, b, left), rel=1e-4, abs=1e-5)
    assert result.lanes[1].ground == pytest.approx((a, b, right), rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("distortion", [(0.0, 0.0, 0.0, 0.0, 0.0), WIDE])
@pytest.mark.parametrize(
    ("pitch", "yaw", "roll", "lateral", "principal_point"),
    [
        (0.0, 0.0, 0.0, 0.0, None),
        (4.0, 0.0, 0.0, 0.0, None),
        (-2.0, 3.0, 0.0, 0.3, None),
        (3.0, -2.0, 0.0, -0.4, (619.5, 339.5)),
        (3.0, 2.0, 1.5, 0.0, (659.5, 379.5)),
    ],
)
def test_any_camera_measures_the_same_road(
    distortion: Distortion,
    pitch: float,
    yaw: float,
    roll: float,
    lateral: float,
    principal_point: tuple[float, float] | None,
) -> None:
    camera = Camera(
        1.4,
        focal_length=(FOCAL, FOCAL),
        principal_point=principal_point,
        image_size=SIZE,
        distortion=distortion,
        roll=roll,
        lateral=lateral,
    )
    a, b = 0.5 / 700.0, math.tan(math.radians(0.8))
    result = result_of(camera, {1: (a, b, 1.9), 2: (a, b, -1.6)}, pitch=pitch, yaw=yaw)
    ego = values(ego_of(in_meters(result, camera, Estimate(yaw, 0.0))))
    assert ego["offset"] == pytest.approx(0.15, abs=0.01), "positive to the right of the lane's center"
    assert ego["lane_width"] == pytest.approx(3.5, abs=0.02)
    assert ego["heading"] == pytest.approx(0.8, abs=0.15)
    assert ego["curvature"] == pytest.approx(1.0 / 700.0, abs=1e-4)
    assert (ego["left"], ego["right"]) == pytest.approx((1.9, 1.6), abs=0.02)
    assert ego["lateral_speed"] == pytest.approx(0.25 * 1.4)


def test_a_camera_that_looks_down_measures_the_same_road() -> None:
    camera = Camera(1.4, focal_length=(FOCAL, FOCAL), image_size=SIZE, roll=1.0)
    a, b = 0.5 / 700.0, math.tan(math.radians(0.8))
    result = result_of(camera, {1: (a, b, 1.9), 2: (a, b, -1.6)}, pitch=25.0)
    assert result.horizon < -0.2 * SIZE[1], "above the image"
    ego = values(ego_of(in_meters(result, camera)))
    assert (ego["left"], ego["right"]) == pytest.approx((1.9, 1.6), abs=0.01)
    assert ego["heading"] == pytest.approx(0.8, abs=0.15)
    assert ego["curvature"] == pytest.approx(1.0 / 700.0, abs=2e-4)


def test_a_principal_point_that_is_given_leaves_no_heading_bias() -> None:
    actual = Camera(1.4, 62.0, principal_point=(659.5, 359.5), image_size=SIZE)
    result = result_of(actual, {1: (0.0, 0.0, 1.75), 2: (0.0, 0.0, -1.75)})
    assert abs(values(ego_of(in_meters(result, actual)))["heading"]) < 0.01
    assumed = replace(actual, principal_point=None)
    assert values(ego_of(in_meters(result, assumed)))["heading"] == pytest.approx(-1.07, abs=0.03), "20 pixels off"


@pytest.mark.parametrize("distortion", [(0.0, 0.0, 0.0, 0.0, 0.0), WIDE])
def test_sigmas_are_those_of_noise_in_the_image(distortion: Distortion) -> None:
    camera = Camera(1.4, focal_length=(FOCAL, FOCAL), distortion=distortion)
    result = result_of(camera, {1: (5e-4, 0.01, 1.9), 2: (5e-4, 0.01, -1.6)}, sigma=0.3)
    rng = np.random.default_rng(20)
    samples = []
    for _ in range(300):
        lanes = tuple(
            replace(
                lane,
                curve=Curve(
                    lane.curve.horizon,
                    tuple(rng.multivariate_normal(lane.curve.coefficients, lane.covariance).tolist()),
                ),
            )
            for lane in result.lanes
        )
        samples.append(
            [lane.ground or (0.0, 0.0, 0.0) for lane in in_meters(replace(result, lanes=lanes), camera).lanes]
        )
    spread = np.std(samples, axis=0)
    lanes = in_meters(result, camera).lanes
    reported = np.sqrt([np.diagonal(lane.ground_covariance) for lane in lanes if lane.ground_covariance is not None])
    assert reported == pytest.approx(spread, rel=0.15)


def test_an_error_of_the_horizon_does_not_change_what_applies_at_the_vehicle() -> None:
    camera = Camera(1.4, 62.0)
    result = result_of(camera, {1: (5e-4, 0.01, 1.9), 2: (5e-4, 0.01, -1.6)})
    lanes = tuple(replace(lane, curve=replace(lane.curve, horizon=result.horizon + 4.0)) for lane in result.lanes)
    moved = values(ego_of(in_meters(replace(result, horizon=result.horizon + 4.0, lanes=lanes), camera)))
    assert moved == pytest.approx(values(ego_of(in_meters(result, camera))), rel=0.01, abs=1e-3)


def test_a_doubtful_yaw_makes_the_heading_doubtful() -> None:
    camera = Camera(1.4, 62.0)
    result = result_of(camera, {1: (0.0, 0.0, 1.75)}, sigma=1e-6)
    heading = ego_of(in_meters(result, camera, Estimate(0.0, 0.5))).heading
    assert heading is not None
    assert math.degrees(heading.sigma) == pytest.approx(0.5, abs=1e-3)


def test_one_boundary_gives_its_distance_and_the_direction_of_the_road() -> None:
    camera = Camera(1.4, 62.0)
    result = in_meters(result_of(camera, {2: (5e-4, 0.01, -1.6)}), camera)
    ego = ego_of(result)
    assert (ego.offset, ego.lane_width, ego.left) == (None, None, None)
    assert values(ego)["right"] == pytest.approx(1.6, abs=1e-3)
    assert values(ego)["heading"] == pytest.approx(math.degrees(0.01), abs=1e-2)
    assert values(ego)["curvature"] == pytest.approx(1e-3, abs=1e-5)


def test_a_lens_that_folds_the_image_gives_no_meters() -> None:
    camera = Camera(1.4, focal_length=(FOCAL, FOCAL), distortion=(-100.0, 100.0, 50.0, -50.0, 100.0))
    good = Camera(1.4, focal_length=(FOCAL, FOCAL))
    result = in_meters(result_of(good, {1: (0.0, 0.0, 1.75), 2: (0.0, 0.0, -1.75)}), camera)
    grounds = np.array([lane.ground or (0.0, 0.0, 0.0) for lane in result.lanes])
    assert np.isfinite(grounds).all()


class FoldedLens(Lens):
    """A lens whose distortion maps all pixels to one ray."""

    def rays(self, pixels: FloatArray) -> FloatArray:
        return np.full(pixels.shape, 0.1)


def test_a_lens_that_shows_all_points_at_one_distance_gives_no_meters() -> None:
    camera = Camera(1.4, 62.0)
    result = result_of(camera, {1: (0.0, 0.0, 1.75), 2: (0.0, 0.0, -1.75)})
    lens = FoldedLens(**vars(camera.lens(SIZE, SIZE)))
    found = with_meters(result, camera, lens, Estimate(0.0, 0.0), SIZE[1] - 1.0)
    assert [lane.ground for lane in found.lanes] == [None, None]
    assert found.ego.meters is None


angles = st.floats(-30.0, 30.0)


@given(
    focal=st.tuples(st.floats(10.0, 1e5), st.floats(10.0, 1e5)),
    principal_point=st.tuples(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5)),
    distortion=st.tuples(*[st.floats(-100.0, 100.0)] * 5),
    roll=angles,
    yaw=angles,
    horizon=st.floats(-700.0, 700.0),
    k=st.floats(-1e6, 1e6),
)
def test_no_camera_gives_an_error_or_a_value_that_is_not_finite(
    focal: tuple[float, float],
    principal_point: tuple[float, float],
    distortion: Distortion,
    roll: float,
    yaw: float,
    horizon: float,
    k: float,
) -> None:
    camera = Camera(1.4, None, focal, principal_point, SIZE, distortion, None, yaw, roll)
    result = result_of(Camera(1.4, 62.0), {1: (0.0, 0.0, 1.75), 2: (0.0, 0.0, -1.75)})
    lanes = tuple(replace(lane, curve=Curve(horizon, (639.5, 1.2, k))) for lane in result.lanes)
    found = in_meters(replace(result, lanes=lanes, horizon=horizon), camera, Estimate(yaw, 0.0))
    numbers = [number for lane in found.lanes if lane.ground is not None for number in lane.ground]
    assert np.isfinite(numbers).all()
    meters = vars(found.ego.meters or EgoMeters()).values()
    assert np.isfinite([(each.value, each.sigma) for each in meters if each is not None]).all()
    assert math.isfinite(camera.horizon(camera.lens(SIZE, SIZE), 720))
    assert math.isfinite(camera.middle(camera.lens(SIZE, SIZE)))


def test_a_frame_without_boundaries_has_no_meters() -> None:
    camera = Camera(1.4, 62.0)
    empty = FrameResult((), EgoLane(), 300.0)
    assert in_meters(empty, camera) == empty


def test_a_boundary_that_is_visible_in_two_rows_has_meters() -> None:
    camera = Camera(1.4, 62.0)
    result = result_of(camera, {1: (5e-4, 0.01, 1.9)})
    short = tuple(replace(lane, top=500.0, bottom=502.0) for lane in result.lanes)
    assert in_meters(replace(result, lanes=short), camera).lanes[0].ground == pytest.approx((5e-4, 0.01, 1.9), rel=1e-2)


def test_a_message_is_exact_to_a_millimeter_at_a_hundred_meters() -> None:
    camera = Camera(1.4, 62.0)
    a, b, c = 5e-4, -0.012, 1.871234
    result = in_meters(result_of(camera, {1: (a, b, c)}, pitch=0.0), camera)
    timing = dict.fromkeys(("decode", "propose", "queue", "infer", "track", "total"), 1.0)
    message = lanes_message(ProcessedFrame(SIZE, replace(result, timing_ms=timing)), seq=0, timestamp=0.0)
    ground, exact = message.lanes[0].ground, result.lanes[0].ground
    assert ground is not None
    assert exact is not None
    for forward in (0.0, 20.0, 100.0):
        powers = forward**2, forward, 1.0
        assert np.dot(ground, powers) == pytest.approx(np.dot(exact, powers), abs=1e-3)
    assert message.lanes[0].ground_covariance is not None


def test_meters_take_a_fraction_of_a_millisecond() -> None:
    camera = Camera(1.4, focal_length=(FOCAL, FOCAL), distortion=WIDE)
    sides = {track: (5e-4, 0.01, 6.0 - 2.0 * track) for track in range(1, 7)}
    result = result_of(camera, sides)
    times = []
    for _ in range(50):
        began = time.perf_counter()
        in_meters(result, camera)
        times.append(time.perf_counter() - began)
    assert min(times) < 1e-3
