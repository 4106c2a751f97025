"""The unpainted ground: materials, wheel tracks, joints, seams, cracks, repairs and dust."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream_exporter.scenes.noise import ground_noise, noise_tiles, sample_noise
from lanestream_exporter.scenes.projection import Float32Array, GroundGrid, coverage, pulse

if TYPE_CHECKING:
    from lanestream.road.curve import FloatArray

Color = tuple[float, float, float]  # blue, green, red, each 0 to 1, display-referred

PROFILE_REACH = 60.0  # meters to either side covered by the lateral profile
PROFILE_STEP = 0.01  # meters
PROFILE_BLURS = (3, 9, 27, 81)  # largest footprint of a pixel in profile steps, from near rows to far ones


@dataclass(frozen=True)
class SurfaceMaterial:
    """A strip of one material, from u = low to u = high in meters."""

    low: float
    high: float
    color: Color
    roughness: float  # strength of its blotches relative to asphalt


@dataclass(frozen=True)
class WheelTrack:
    """A soft dark band along the road (light if `depth` is negative): tire polish, oil, dust."""

    u: float
    width: float  # sigma, meters
    depth: float


@dataclass(frozen=True)
class Seam:
    """A thin line along the road that is never a lane boundary: a sawn joint, a tar seam, a pavement edge."""

    u: float
    width: float  # meters
    depth: float  # share of light that it absorbs; negative if it is lighter than its surroundings
    wander: float = 0.0  # amplitude of the lateral wander, meters
    breaks: float = 0.0  # from 0, an unbroken line, to 1, mostly gaps
    seed: int = 0


@dataclass(frozen=True)
class Joint:
    """Lines across the road from u = low to u = high, every `period` meters."""

    low: float
    high: float
    period: float
    width: float
    depth: float


@dataclass(frozen=True)
class PavementRepair:
    """A rectangle of different pavement: a repair, a bridge deck, a change from asphalt to concrete. Meters."""

    s: float
    length: float
    low: float
    high: float
    gain: float  # of brightness
    rim: float  # darkness of the sealed joint around it; 0 if there is no joint


@dataclass(frozen=True)
class RaggedEdge:
    """An edge between two materials whose mean line is u, but which runs in and out. Meters."""

    u: float
    roughness: float  # sigma of its distance from the mean line
    cell: float  # size of the smallest notches along the road
    seed: int


@dataclass(frozen=True)
class Dust:
    """A film of dust over asphalt and paint, thickest at the edge u and gone after `reach` toward the road. Meters."""

    u: float
    reach: float
    inward: float  # direction of the road from the edge: +1 left, -1 right
    color: Color
    thickness: float  # share of the ground that it hides at the edge, 0 to 1
    seed: int


@dataclass(frozen=True)
class Surface:
    """Everything on the ground except paint."""

    materials: tuple[SurfaceMaterial, ...]  # later ones cover earlier ones
    tracks: tuple[WheelTrack, ...] = ()
    seams: tuple[Seam, ...] = ()
    joints: tuple[Joint, ...] = ()
    repairs: tuple[PavementRepair, ...] = ()
    ragged: tuple[RaggedEdge, ...] = ()
    dust: tuple[Dust, ...] = ()
    grain: float = 0.04  # strength of the aggregate texture
    mottle: float = 0.05  # strength of blotches
    streaks: float = 0.04  # strength of marks along the direction of travel
    cracks: float = 0.0  # darkness of cracks
    pits: float = 0.0  # darkness of small holes and spots of dirt
    seed: int = 0


def paint_ground(grid: GroundGrid, surface: Surface) -> Float32Array:
    """Returns the unlit ground, (rows, width, 3) in blue, green, red, 0 to 1."""
    ground, roughness = _lay_materials(grid, surface)
    gain = _texture(grid, surface, roughness) + np.float32(1.0)
    if surface.cracks > 0.0:
        gain *= _cracks(grid, surface)
    _lay_repairs(grid, surface, gain)
    _draw_joints(grid, surface, gain)
    _draw_seams(grid, surface, gain)
    ground *= np.maximum(gain, 0.05)[..., None]
    return np.asarray(ground, dtype=np.float32)


def _lay_materials(grid: GroundGrid, surface: Surface) -> tuple[Float32Array, Float32Array]:
    """Returns color (rows, width, 3) and roughness (rows, width) of the ground, looked up by lateral position.

    The profile is blurred to the footprint of a pixel, in a few steps from near to far rows, to keep edges smooth.
    """
    profile = _profile(surface)
    index = _profile_index(grid.u)
    for edge in surface.ragged:
        _fray(grid, edge, index)
    np.clip(index, 0, len(profile) - 1, out=index)
    ground = np.empty((*grid.shape, 3), np.float32)
    roughness = np.empty(grid.shape, np.float32)
    steps = grid.x / np.float32(grid.projection.camera.focal * PROFILE_STEP)
    levels = np.searchsorted(PROFILE_BLURS[:-1], steps)
    for level, blur in enumerate(PROFILE_BLURS):
        rows = np.flatnonzero(levels == level)
        if len(rows):
            smooth = cv2.blur(profile, (1, blur), borderType=cv2.BORDER_REPLICATE)
            block = slice(rows[0], rows[-1] + 1)  # the footprint grows with distance, so a level's rows are contiguous
            ground[block] = np.take(smooth[:, :3], index[block], axis=0)
            roughness[block] = np.take(smooth[:, 3], index[block])
    return ground, roughness


def _profile_index(u: Float32Array) -> NDArray[np.int32]:
    """Returns the nearest entries of the lateral profile; they may lie outside it."""
    return np.asarray((u + np.float32(PROFILE_REACH)) * np.float32(1.0 / PROFILE_STEP) + np.float32(0.5), np.int32)


def _fray(grid: GroundGrid, edge: RaggedEdge, index: NDArray[np.int32]) -> None:
    """Shifts the lookup of the materials beside a ragged edge, in place; the shift has zero mean."""
    band = grid.band(edge.u - 4.0 * edge.roughness, edge.u + 4.0 * edge.roughness)
    along = np.zeros_like(band.s)
    shift = sample_noise(noise_tiles().fine, along, band.s, (1.0, edge.cell), edge.seed)
    shift += 0.8 * sample_noise(noise_tiles().fine, along, band.s, (1.0, 4.0 * edge.cell), edge.seed + 1)
    # A far pixel averages over many notches.
    shift *= np.float32(0.78 * edge.roughness) * np.minimum(1.0, 3.0 * edge.cell / np.maximum(band.along, 0.01))
    index.reshape(-1)[band.index] = _profile_index(band.u + shift)


def cover_with_dust(grid: GroundGrid, dust: Dust, ground: Float32Array) -> None:
    """Covers the painted, unlit ground with dust, in place."""
    far = dust.u + dust.inward * dust.reach
    band = grid.band(min(dust.u, far), max(dust.u, far))
    share = np.clip((far - band.u) * np.float32(dust.inward / dust.reach), 0.0, 1.0)
    share *= (band.u - np.float32(dust.u)) * np.float32(dust.inward) > 0.0
    noise = sample_noise(noise_tiles().cloud, band.u, band.s, (0.02, 0.06), dust.seed)
    share = np.clip(np.float32(dust.thickness) * share * (1.0 + 0.4 * noise), 0.0, 0.95)[:, None]
    flat = ground.reshape(-1, 3)
    flat[band.index] += share * (np.array(dust.color, np.float32) - flat[band.index])


def _profile(surface: Surface) -> Float32Array:
    """Returns blue, green, red and roughness by lateral position, (N, 4)."""
    u: FloatArray = np.arange(-PROFILE_REACH, PROFILE_REACH, PROFILE_STEP)
    profile = np.ones((len(u), 4), np.float32)
    for material in surface.materials:
        inside = slice(*np.searchsorted(u, (material.low, material.high)))
        profile[inside] = (*material.color, material.roughness)
    gain = np.ones(len(u))
    for track in surface.tracks:
        gain -= track.depth * np.exp(-0.5 * ((u - track.u) / track.width) ** 2)
    profile[:, :3] *= gain[:, None].astype(np.float32)
    return profile


def _texture(grid: GroundGrid, surface: Surface, roughness: Float32Array) -> Float32Array:
    """Returns the zero-mean texture of the ground. Rough ground has more texture, but fewer tire marks."""
    tiles = noise_tiles()
    texture = ground_noise(tiles.cloud, grid, (0.035, 0.05), surface.seed)
    texture *= np.float32(surface.mottle)
    near = int(np.argmax(np.append(grid.x < 16.0, True)))
    if near < len(grid.x):
        fine = sample_noise(tiles.fine, grid.u[near:], grid.s[near:], (0.009, 0.012), surface.seed + 2)
        fine *= np.clip((16.0 - grid.x[near:]) / 8.0, 0.0, 1.0)[:, None]
        texture[near:] += np.float32(surface.grain) * fine
        if surface.pits > 0.0:
            holes = sample_noise(tiles.fine, grid.u[near:], grid.s[near:], (0.017, 0.024), surface.seed + 4)
            texture[near:] -= np.float32(surface.pits) * np.clip(holes - 1.9, 0.0, 1.0)
    texture *= roughness
    streaks = ground_noise(tiles.cloud, grid, (0.03, 0.9), surface.seed + 1)
    streaks *= np.float32(surface.streaks) / np.square(roughness)
    texture += streaks
    return texture


def _cracks(grid: GroundGrid, surface: Surface) -> Float32Array:
    """Returns a gain that is dark along the zero crossings of smooth noise, which look like cracks."""
    noise = sample_noise(noise_tiles().cloud, grid.u, grid.s, (0.06, 0.16), surface.seed + 3)
    footprint = np.maximum(0.012, grid.along * 0.35)[:, None]
    depth = np.minimum(1.0, 0.02 / footprint) * surface.cracks
    lines = np.maximum(0.0, 1.0 - np.abs(noise) / (3.0 * footprint))
    return np.asarray(1.0 - depth * lines, dtype=np.float32)


def _lay_repairs(grid: GroundGrid, surface: Surface, gain: Float32Array) -> None:
    flat = gain.reshape(-1)
    for repair in surface.repairs:
        if not grid.projection.overlaps(repair.s, repair.s + repair.length):
            continue
        band = grid.band(repair.low, repair.high)
        center_s = np.float32(repair.s + repair.length / 2.0)
        inside = coverage(band.s - center_s, repair.length, band.along)
        center_u = np.float32((repair.low + repair.high) / 2.0)
        inside *= coverage(band.u - center_u, repair.high - repair.low, band.across)
        flat[band.index] *= 1.0 + np.float32(repair.gain - 1.0) * inside
        if repair.rim > 0.0:
            core = coverage(band.s - center_s, repair.length - 0.08, band.along)
            core *= coverage(band.u - center_u, repair.high - repair.low - 0.08, band.across)
            flat[band.index] *= 1.0 - np.float32(repair.rim) * (inside - core)


def _draw_joints(grid: GroundGrid, surface: Surface, gain: Float32Array) -> None:
    flat = gain.reshape(-1)
    for joint in surface.joints:
        band = grid.band(joint.low, joint.high)
        inside = (band.u > joint.low) & (band.u < joint.high)
        flat[band.index] *= 1.0 - np.float32(joint.depth) * inside * pulse(
            band.s, joint.period, joint.width, band.along
        )


def _draw_seams(grid: GroundGrid, surface: Surface, gain: Float32Array) -> None:
    flat, cloud = gain.reshape(-1), noise_tiles().cloud
    for seam in surface.seams:
        reach = seam.width + 3.0 * seam.wander
        band = grid.band(seam.u - reach, seam.u + reach)
        offset = band.u - np.float32(seam.u)
        if seam.wander > 0.0:
            offset -= np.float32(seam.wander) * sample_noise(
                cloud, np.zeros_like(band.s), band.s, (1.0, 0.12), seam.seed
            )
        depth = coverage(offset, seam.width, band.across) * np.float32(seam.depth)
        if seam.breaks > 0.0:
            noise = sample_noise(cloud, np.zeros_like(band.s), band.s, (1.0, 0.3), seam.seed + 1)
            depth *= np.clip((noise + 1.5 - 3.0 * seam.breaks) * 4.0, 0.0, 1.0)
        flat[band.index] *= 1.0 - depth
