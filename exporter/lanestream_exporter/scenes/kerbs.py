"""Kerbs: their face, from the foot at the edge of the pavement, and their top, plain or painted in blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from lanestream.road.curve import FloatArray
    from lanestream_exporter.scenes.render_target import RenderTarget
    from lanestream_exporter.scenes.surface import Color

_NEAREST: Final = 0.3  # meters ahead of the lens where a kerb starts
_BLOCKS_REACH: Final = 40.0  # meters ahead; farther blocks merge into their mean color


@dataclass(frozen=True)
class Kerb:
    """A kerb whose foot is at lateral position u. Meters."""

    u: float
    outward: float  # direction from the road: +1 for the left kerb, -1 for the right one
    height: float
    width: float  # of its top
    color: Color
    other: Color | None = None  # of every second block, if the kerb is painted in blocks
    block: float = 1.0  # length of a block
    shade: float = 0.8  # brightness of the face relative to the top


def draw_kerb(target: RenderTarget, kerb: Kerb) -> None:
    """Draws a kerb from far to near."""
    projection = target.projection
    start = projection.vehicle_s + _NEAREST
    end = float(projection.s[projection.x < projection.reach][-1])
    places, colors = _parts(kerb, start, end)
    if len(places) < 2:
        return
    u = np.full(len(places), kerb.u)
    foot = projection.project(places, u, np.zeros(len(places)))
    foot[:, 0] -= kerb.outward  # OpenCV draws smooth polygons about a pixel too wide
    head = projection.project(places, u, np.full(len(places), kerb.height))
    back = projection.project(places, u + kerb.outward * kerb.width, np.full(len(places), kerb.height))
    x, y = projection.to_vehicle(places, u)
    right = target.image.shape[1]
    for near in range(len(places) - 2, -1, -1):
        columns = head[near : near + 2, 0]
        if columns.max() < -200.0 or columns.min() > right + 200.0:
            continue
        color = colors[near]
        tone = target.tone(color, float(x[near]), float(y[near]))
        face: Color = (color[0] * kerb.shade, color[1] * kerb.shade, color[2] * kerb.shade)
        target.polygon(_quad(head, back, near), tone)
        target.polygon(_quad(foot, head, near), target.tone(face, float(x[near]), float(y[near])))


def _quad(low: FloatArray, high: FloatArray, near: int) -> FloatArray:
    return np.concatenate([low[near : near + 2], high[near : near + 2][::-1]])


def _parts(kerb: Kerb, start: float, end: float) -> tuple[FloatArray, list[Color]]:
    """Returns the places (N,) between which parts of one color lie, meters along the road, and the N - 1 colors."""
    steps = np.concatenate([np.arange(0.0, 30.0, 2.5), np.arange(30.0, 90.0, 6.0), np.arange(90.0, 300.0, 15.0)])
    plain = np.append(start + steps[steps < end - start - 0.1], end)
    if kerb.other is None:
        return plain, [kerb.color] * (len(plain) - 1)
    first = int(np.ceil(start / kerb.block))
    last = int(min(start + _BLOCKS_REACH, end) / kerb.block)
    blocks = np.arange(first, last + 1) * kerb.block
    places = np.concatenate([[start], blocks[blocks > start], plain[plain > blocks[-1] + 0.1]])
    mean: Color = (
        (kerb.color[0] + kerb.other[0]) / 2.0,
        (kerb.color[1] + kerb.other[1]) / 2.0,
        (kerb.color[2] + kerb.other[2]) / 2.0,
    )
    colors = []
    for place in places[:-1]:
        number = int(np.floor(place / kerb.block + 0.01))
        colors.append(mean if place >= blocks[-1] else (kerb.color if number % 2 else kerb.other))
    return places, colors
