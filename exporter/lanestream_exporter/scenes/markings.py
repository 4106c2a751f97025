"""Paint and dots on the lane boundaries, and marks on the road that aren't lane boundaries."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from lanestream_exporter.scenes.noise import noise_tiles, sample_noise
from lanestream_exporter.scenes.projection import Float32Array, GroundBand, GroundGrid, coverage, pulse

if TYPE_CHECKING:
    from lanestream_exporter.scenes.road import Boundary, Marking, Road
    from lanestream_exporter.scenes.surface import Color

DOT_RISE = 0.02  # height of a dot above the road, meters
STENCIL_SCALE = 50.0  # resolution of a stencil's mask, pixels per meter


@dataclass(frozen=True)
class GhostMarking:
    """The remains of an old marking: gray, thin, away from the current boundaries. Not a lane boundary."""

    u: float
    marking: Marking
    sway: float  # amplitude of its lateral swing, meters
    swing: float  # wavelength of the swing, meters
    tone: float  # brightness, 0 to 1


@dataclass(frozen=True)
class Stencil:
    """A word or an arrow inside a lane, stretched along the road so that drivers can read it."""

    text: str  # a word in capitals, or one of "^", "<", ">" for an arrow ahead, left, right
    s: float  # of its near end, meters
    u: float  # of its center
    length: float
    width: float
    brightness: float
    wear: float
    seed: int


@dataclass(frozen=True)
class Bars:
    """Bars across the road: a stop line, or the bars of a crosswalk or a speed bump. Meters."""

    s: float
    length: float  # along the road
    low: float
    high: float
    period: float  # across the road; 0 for a single unbroken bar
    bar: float  # width of each bar across the road
    brightness: float
    wear: float
    seed: int
    yellow: bool = False


@dataclass(frozen=True)
class ParkingBays:
    """Lines across the road from u = low to u = high, every `period` meters, that separate parking bays."""

    low: float
    high: float
    period: float
    width: float
    color: Color
    wear: float
    seed: int


@dataclass(frozen=True)
class Paintwork:
    """All paint on the road that isn't a lane boundary."""

    ghosts: tuple[GhostMarking, ...] = ()
    stencils: tuple[Stencil, ...] = ()
    bars: tuple[Bars, ...] = ()
    bays: tuple[ParkingBays, ...] = ()


def paint_color(marking: Marking) -> Color:
    """Returns blue, green, red of a marking in full daylight."""
    shade, fade = marking.brightness, marking.fade
    if marking.color == "white":
        return (0.97 * shade, shade, 0.99 * shade)
    return ((0.28 + 0.55 * fade) * shade, (0.78 + 0.1 * fade) * shade, shade)


def paint_boundaries(grid: GroundGrid, road: Road, ground: Float32Array) -> None:
    """Paints every marked boundary onto the unlit ground, in place."""
    for boundary in road.boundaries:
        if boundary.marking:
            band = _around(grid, boundary, boundary.marking)
            _blend(ground, band, marking_coverage(band, boundary.u, boundary.marking), paint_color(boundary.marking))


def paint_other_marks(grid: GroundGrid, paintwork: Paintwork, ground: Float32Array) -> None:
    """Paints ghost markings, stencils, bars and parking bays onto the unlit ground, in place."""
    projection = grid.projection
    for ghost in paintwork.ghosts:
        band = grid.band(ghost.u - ghost.sway - 0.3, ghost.u + ghost.sway + 0.3)
        offset = np.float32(ghost.sway) * np.sin(band.s * np.float32(math.tau / ghost.swing))
        cover = marking_coverage(replace(band, u=band.u - offset), ghost.u, ghost.marking)
        _blend(ground, band, cover, (ghost.tone, ghost.tone, ghost.tone))
    for stencil in paintwork.stencils:
        if projection.overlaps(stencil.s, stencil.s + stencil.length):
            _paint_stencil(grid, stencil, ground)
    for bars in paintwork.bars:
        if projection.overlaps(bars.s, bars.s + bars.length):
            _paint_bars(grid, bars, ground)
    for bays in paintwork.bays:
        band = grid.band(bays.low, bays.high)
        cover = pulse(band.s, bays.period, bays.width, band.along) * ((band.u > bays.low) & (band.u < bays.high))
        _blend(ground, band, cover * _paint_left(band, bays.wear, bays.seed), bays.color)


def marking_coverage(band: GroundBand, u: float, marking: Marking) -> Float32Array:
    """Returns the share of each pixel of the band that is covered by paint, (N,)."""
    offset = band.u - np.float32(u)
    s = band.s - np.float32(marking.phase)
    if marking.type == "dots":
        return _dots(band, offset, s, marking)
    if marking.type == "double":
        half = np.float32((marking.gap + marking.width) / 2.0)
        stripes = []
        for name, side in (("left", half), ("right", -half)):
            stripe = coverage(offset - side, marking.width, band.across)
            broken = marking.broken == name
            stripes.append(stripe * pulse(s, marking.period, marking.dash, band.along) if broken else stripe)
        cover = stripes[0] + stripes[1]
    else:
        cover = coverage(offset, marking.width, band.across)
        if marking.type == "dashed":
            cover *= pulse(s, marking.period, marking.dash, band.along)
    return cover * _paint_left(band, marking.wear, marking.seed)


def _around(grid: GroundGrid, boundary: Boundary, marking: Marking) -> GroundBand:
    """Returns the pixels that a marking may touch: its stripes plus a margin for the footprint of far pixels.

    A taper is undone: the u of the pixels is as if the boundary were straight.
    """
    reach, u, taper = 1.5 * marking.width + marking.gap + 0.1, boundary.u, boundary.taper
    if taper:
        band = grid.band(u + min(0.0, taper.shift) - reach, u + max(0.0, taper.shift) + reach)
        band = replace(band, u=band.u - taper.shift_at(band.s.astype(np.float64)).astype(np.float32))
    else:
        band = grid.band(u - reach, u + reach)
    limited = math.isfinite(boundary.first) or math.isfinite(boundary.last)
    return band.within(boundary.first, boundary.last) if limited else band


def _dots(band: GroundBand, offset: Float32Array, s: Float32Array, marking: Marking) -> Float32Array:
    """Returns the coverage by groups of raised dots; at a grazing angle their sides lengthen them on the ground."""
    spacing = marking.dash / (marking.dots - 1) if marking.dots > 1 else marking.period
    rise = np.float32(DOT_RISE * 0.7) * band.distance
    length = np.float32(marking.width) + np.minimum(rise, np.float32(0.4 * spacing))
    within = np.mod(s, np.float32(marking.period))
    nearest = np.clip(np.round(within / spacing), 0, marking.dots - 1) * np.float32(spacing)
    ahead = (within - nearest).astype(np.float32)
    cover = coverage(ahead, length.astype(np.float32), np.maximum(band.along, 0.01))
    # A dot is round, so it narrows towards its near and far ends.
    chord = np.sqrt(np.clip(1.0 - np.square(ahead / length) * 3.0, 0.1, 1.0)).astype(np.float32)
    cover *= coverage(offset, np.float32(marking.width) * chord, band.across)
    keep = np.random.default_rng(marking.seed).random(64) >= marking.wear
    group = np.floor(s / np.float32(marking.period)) * marking.dots + nearest / np.float32(spacing)
    return np.asarray(cover * keep[np.round(group).astype(np.int64) % 64], dtype=np.float32)


def _paint_left(band: GroundBand, wear: float, seed: int) -> Float32Array:
    """Returns the share of paint left, (N,): chipped where noise at two scales falls below the wear."""
    if wear <= 0.0:
        return np.ones_like(band.u)
    tiles = noise_tiles()
    noise = sample_noise(tiles.cloud, band.u, band.s, (0.012, 0.05), seed)
    noise += 0.6 * sample_noise(tiles.fine, band.u, band.s, (0.012, 0.02), seed + 1)
    # A far pixel averages over many chips, so its noise shrinks towards the mean.
    fade = np.minimum(1.0, 0.15 / np.maximum(np.maximum(band.across, band.along), 1e-3)).astype(np.float32)
    threshold = np.float32(-2.2 + 3.6 * wear)
    soft = np.clip((noise * fade - threshold) / (0.35 + 1.5 * (1.0 - fade)), 0.0, 1.0)
    return np.asarray(soft * np.float32(1.0 - 0.35 * wear), dtype=np.float32)


def _blend(ground: Float32Array, band: GroundBand, cover: Float32Array, color: Color) -> None:
    flat = ground.reshape(-1, 3)
    cover = np.clip(cover, 0.0, 1.0)[:, None]
    ground_color = flat[band.index]
    flat[band.index] = ground_color + cover * (np.array(color, np.float32) - ground_color)


def _paint_stencil(grid: GroundGrid, stencil: Stencil, ground: Float32Array) -> None:
    band = grid.band(stencil.u - stencil.width / 2.0, stencil.u + stencil.width / 2.0)
    band = band.within(stencil.s, stencil.s + stencil.length)
    if not band.index.size:
        return
    mask = stencil_mask(stencil.text)
    rows, columns = mask.shape
    right = (np.float32(stencil.u + stencil.width / 2.0) - band.u) * np.float32(columns / stencil.width)
    down = (np.float32(stencil.s + stencil.length) - band.s) * np.float32(rows / stencil.length)
    cover = mask[np.clip(down, 0, rows - 1).astype(np.intp), np.clip(right, 0, columns - 1).astype(np.intp)]
    shade = stencil.brightness
    _blend(ground, band, cover * _paint_left(band, stencil.wear, stencil.seed), (shade, shade, shade))


def stencil_mask(text: str) -> Float32Array:
    """Returns a word or an arrow as a mask, 0 to 1; its top row is the farthest along the road."""
    size = round(2.4 * STENCIL_SCALE)
    mask = np.zeros((size, size), np.uint8)
    if text in {"^", "<", ">"}:
        shaft = [(0.44, 1.0), (0.44, 0.35), (0.56, 0.35), (0.56, 1.0)]
        head = {
            "^": [(0.25, 0.38), (0.5, 0.0), (0.75, 0.38)],
            "<": [(0.56, 0.3), (0.56, 0.42), (0.3, 0.42), (0.3, 0.55), (0.05, 0.35), (0.3, 0.15), (0.3, 0.3)],
            ">": [(0.44, 0.3), (0.44, 0.42), (0.7, 0.42), (0.7, 0.55), (0.95, 0.35), (0.7, 0.15), (0.7, 0.3)],
        }[text]
        for outline in (shaft, head):
            cv2.fillPoly(mask, [(np.array(outline) * (size - 1)).astype(np.int32)], (255,), cv2.LINE_AA)
    else:
        scale, thickness = 3.0, 14
        (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thickness)
        raster = np.zeros((height + thickness, width + thickness), np.uint8)
        origin = (thickness // 2, height + thickness // 2)
        cv2.putText(raster, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, thickness, cv2.LINE_AA)
        cv2.resize(raster, (size, size), mask, interpolation=cv2.INTER_AREA)
    return np.asarray(mask, dtype=np.float32) / np.float32(255.0)


def _paint_bars(grid: GroundGrid, bars: Bars, ground: Float32Array) -> None:
    # A far pixel covers meters of road, so the ends of the bars show up to a meter beyond them.
    band = grid.band(bars.low, bars.high).within(bars.s - 1.0, bars.s + bars.length + 1.0)
    cover = coverage(band.s - np.float32(bars.s + bars.length / 2.0), bars.length, band.along)
    if bars.period > 0.0:
        cover *= pulse(band.u - np.float32(bars.low), bars.period, bars.bar, band.across)
    cover *= (band.u > bars.low) & (band.u < bars.high)
    shade = bars.brightness
    color: Color = (0.28 * shade, 0.78 * shade, shade) if bars.yellow else (shade, shade, shade)
    _blend(ground, band, cover * _paint_left(band, bars.wear, bars.seed), color)
