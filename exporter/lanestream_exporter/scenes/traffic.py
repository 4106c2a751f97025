"""Other vehicles, drawn as boxes with a cabin, windows, wheels, lights and a shadow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

from lanestream_exporter.scenes.render_target import SUBPIXEL_BITS, fixed_point

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lanestream.road.curve import FloatArray
    from lanestream.road.view import Image
    from lanestream_exporter.scenes.projection import RoadProjection
    from lanestream_exporter.scenes.render_target import RenderTarget
    from lanestream_exporter.scenes.surface import Color

NEAREST = 0.7  # meters ahead of the lens where vehicles are clipped
VehicleKind = Literal["car", "van", "truck"]
BoxPoint = tuple[float, float, float]  # shares of length (from the near end), width (from the right), height

GLASS: Color = (0.16, 0.14, 0.12)
RUBBER: Color = (0.05, 0.05, 0.05)


@dataclass(frozen=True)
class Vehicle:
    """A vehicle on the road with its near end at s and its center at u. Meters, meters per second."""

    kind: VehicleKind
    s: float
    u: float
    speed: float  # along s; negative for oncoming vehicles
    length: float
    width: float
    height: float
    color: Color
    braking: bool = False

    @property
    def oncoming(self) -> bool:
        """Returns whether the vehicle shows its front."""
        return self.speed < 0.0


@dataclass(frozen=True)
class _Box:
    """The box of a vehicle to draw; maps shares of the box to image points."""

    target: RenderTarget
    vehicle: Vehicle
    x: float
    y: float
    nearest: float  # s where the box is clipped, meters

    def points(self, shares: Sequence[BoxPoint]) -> FloatArray:
        """Returns the image points (N, 2) of points of the box."""
        along, across, up = np.array(shares, dtype=np.float64).T
        car = self.vehicle
        s = np.maximum(car.s + along * car.length, self.nearest)
        return self.target.projection.project(s, car.u + (across - 0.5) * car.width, up * car.height)

    def fill(self, shares: Sequence[BoxPoint], color: Color, gain: float = 1.0) -> None:
        """Fills a shape on the box with a color, lit by the scene."""
        lit: Color = (color[0] * gain, color[1] * gain, color[2] * gain)
        self.target.polygon(self.points(shares), self.target.tone(lit, self.x, self.y))

    def shine(self, shares: Sequence[BoxPoint], color: Color) -> None:
        """Fills a shape on the box that emits light."""
        self.target.polygon(self.points(shares), (255.0 * color[0], 255.0 * color[1], 255.0 * color[2]))


def draw_vehicle(target: RenderTarget, vehicle: Vehicle) -> None:
    """Draws one vehicle with its shadow if it is ahead of the lens and within reach."""
    nearest = target.projection.vehicle_s + NEAREST
    ends = np.maximum([vehicle.s, vehicle.s + vehicle.length], nearest)
    x, y = target.projection.to_vehicle(ends, np.full(2, vehicle.u))
    if ends[1] < nearest + 1.0 or x.max() > target.projection.reach:
        return
    box = _Box(target, vehicle, float(x[0]), float(y[0]), nearest)
    outline = box.points([(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.0, 0.0, 1.0)])
    if outline[:, 0].max() < -50.0 or outline[:, 0].min() > target.image.shape[1] + 50.0:
        return
    _draw_shadow(box)
    side = _visible_side(box)
    if vehicle.kind == "car":
        _draw_car(box, side)
    else:
        _draw_tall(box, side)
    _draw_lights(box)


def _visible_side(box: _Box) -> float | None:
    """Returns 1 if the left side faces the camera, 0 for the right side, None for neither."""
    for side, sign in ((0.0, -1.0), (1.0, 1.0)):
        a, b, c = box.points([(0.0, side, 0.0), (1.0, side, 0.0), (1.0, side, 1.0)])
        if sign * ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])) > 0.0:
            return side
    return None


def _draw_shadow(box: _Box) -> None:
    light = box.target.light
    if light.headlights > 0.0:
        return
    shift = light.sun * box.vehicle.height / box.vehicle.width
    low, high = min(0.0, shift) - 0.04, max(0.0, shift) + 1.04
    ground = [(-0.06, low, 0.0), (-0.06, high, 0.0), (1.0, high, 0.0), (1.0, low, 0.0)]
    width = box.target.projection.camera.focal * 0.07 / box.x
    box.target.darken(box.points(ground), 0.55, width)
    under = [(-0.02, -0.02, 0.0), (-0.02, 1.02, 0.0), (0.98, 1.02, 0.0), (0.98, -0.02, 0.0)]
    box.target.darken(box.points(under), 0.75, width)


def _draw_wheels(box: _Box, side: float, positions: tuple[float, ...], radius: float) -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
    car = box.vehicle
    for wheel in positions:
        for share, color in ((1.0, RUBBER), (0.55, (0.3, 0.3, 0.3))):
            size = radius * share
            rim = [
                (wheel + size * np.cos(a) / car.length, side, (radius + size * np.sin(a)) / car.height) for a in angles
            ]
            box.fill(rim, color)


def _draw_car(box: _Box, side: float | None) -> None:
    color = box.vehicle.color
    if side is not None:
        inner = 0.12 if side == 0.0 else 0.88
        body = [(0.0, 0.2), (0.0, 0.6), (0.1, 0.64), (0.8, 0.62), (1.0, 0.5), (1.0, 0.2)]
        box.fill([(a, side, b) for a, b in body], color, 0.75)
        _draw_wheels(box, side, (0.2, 0.8), 0.32)
        cabin = [(0.06, side, 0.62), (0.2, inner, 0.98), (0.6, inner, 1.0), (0.8, side, 0.62)]
        box.fill(cabin, color, 0.7)
        glass = [(0.14, side, 0.65), (0.24, inner, 0.93), (0.57, inner, 0.94), (0.72, side, 0.65)]
        box.fill(glass, GLASS)
    for wheel in (0.02, 0.78):
        box.fill([(0.02, wheel, 0.0), (0.02, wheel + 0.2, 0.0), (0.02, wheel + 0.2, 0.3), (0.02, wheel, 0.3)], RUBBER)
    box.fill([(0.2, 0.12, 0.98), (0.2, 0.88, 0.98), (0.6, 0.88, 1.0), (0.6, 0.12, 1.0)], color, 1.1)
    box.fill([(0.06, 0.03, 0.62), (0.2, 0.13, 0.99), (0.2, 0.87, 0.99), (0.06, 0.97, 0.62)], color, 0.95)
    box.fill([(0.08, 0.09, 0.66), (0.19, 0.16, 0.93), (0.19, 0.84, 0.93), (0.08, 0.91, 0.66)], GLASS)
    box.fill([(0.0, 0.02, 0.6), (0.06, 0.04, 0.64), (0.06, 0.96, 0.64), (0.0, 0.98, 0.6)], color, 1.15)
    rear = [(0.02, 0.16), (0.0, 0.35), (0.02, 0.61), (0.98, 0.61), (1.0, 0.35), (0.98, 0.16)]
    box.fill([(0.0, across, up) for across, up in rear], color, 0.85)
    box.fill([(0.0, 0.03, 0.14), (0.0, 0.03, 0.24), (0.0, 0.97, 0.24), (0.0, 0.97, 0.14)], color, 0.45)
    box.fill([(0.0, 0.4, 0.36), (0.0, 0.4, 0.45), (0.0, 0.6, 0.45), (0.0, 0.6, 0.36)], (0.7, 0.7, 0.7))


def _draw_tall(box: _Box, side: float | None) -> None:
    """Draws a van or a truck: an upright box on wheels."""
    color, car = box.vehicle.color, box.vehicle
    floor = 0.9 / car.height if car.kind == "truck" else 0.18
    radius = 0.5 if car.kind == "truck" else 0.35
    wheels = (0.12, 0.2, 0.85) if car.kind == "truck" else (0.2, 0.8)
    if side is not None:
        _draw_wheels(box, side, wheels, radius)
        box.fill([(0.0, side, floor), (0.0, side, 1.0), (1.0, side, 1.0), (1.0, side, floor)], color, 0.72)
        box.fill([(0.0, side, floor), (0.0, side, floor + 0.04), (1.0, side, floor + 0.04), (1.0, side, floor)], RUBBER)
        if car.kind == "van":
            pane = [(0.1, side, 0.58), (0.1, side, 0.88), (0.85, side, 0.88), (0.85, side, 0.58)]
            box.fill(pane, GLASS)
    for wheel in (0.04, 0.72):
        tire = [(0.01, wheel, 0.0), (0.01, wheel + 0.24, 0.0), (0.01, wheel + 0.24, floor), (0.01, wheel, floor)]
        box.fill(tire, RUBBER)
    box.fill([(0.0, 0.0, floor), (0.0, 0.0, 1.0), (0.0, 1.0, 1.0), (0.0, 1.0, floor)], color, 0.95)
    if car.kind == "van" or car.oncoming:
        box.fill([(0.0, 0.08, 0.56), (0.0, 0.1, 0.88), (0.0, 0.9, 0.88), (0.0, 0.92, 0.56)], GLASS)
    else:
        box.fill([(0.0, 0.49, floor), (0.0, 0.49, 0.98), (0.0, 0.51, 0.98), (0.0, 0.51, floor)], color, 0.6)
        bar = 0.45 * floor
        box.fill([(0.0, 0.04, bar), (0.0, 0.04, bar * 1.35), (0.0, 0.96, bar * 1.35), (0.0, 0.96, bar)], RUBBER)


def _draw_lights(box: _Box) -> None:
    car = box.vehicle
    base = 0.42 if car.kind == "car" else 0.95 / car.height
    size = 0.1 if car.kind == "car" else 0.05
    night = box.target.light.glow < 0.4
    for inner, outer in ((0.03, 0.17), (0.97, 0.83)):
        lamp = [(0.0, inner, base), (0.0, inner, base + size), (0.0, outer, base + size), (0.0, outer, base)]
        if car.oncoming:
            glow: Color = (1.0, 1.0, 1.0)
        else:
            glow = (0.15, 0.15, 0.95) if car.braking else (0.08, 0.08, 0.6)
        if night or car.braking:
            box.shine(lamp, glow)
            if night and car.oncoming:
                reach = box.target.projection.camera.focal * 1.2 / max(box.x, 10.0)
                box.target.glow(box.points(lamp).mean(axis=0), reach, 0.8)
        else:
            box.fill(lamp, glow, 0.9)


def mark_covered(mask: Image, projection: RoadProjection, vehicle: Vehicle) -> None:
    """Marks the outline of a vehicle's box in a mask (H, W)."""
    nearest = projection.vehicle_s + NEAREST
    if vehicle.s + vehicle.length < nearest + 1.0:
        return
    s, side, up = (
        values.ravel()
        for values in np.meshgrid([max(vehicle.s, nearest), vehicle.s + vehicle.length], [-0.5, 0.5], [0.0, 1.0])
    )
    u = vehicle.u + side * vehicle.width
    if projection.to_vehicle(s, u)[0].max() <= projection.reach:  # not behind a crest
        hull = cv2.convexHull(fixed_point(projection.project(s, u, up * vehicle.height)))
        cv2.fillConvexPoly(mask, hull, (255.0,), cv2.LINE_8, SUBPIXEL_BITS)
