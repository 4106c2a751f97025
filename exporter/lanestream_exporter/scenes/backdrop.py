"""The background: sky, clouds, hills and distant woods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from lanestream_exporter.scenes.noise import TILE, noise_tiles

if TYPE_CHECKING:
    from lanestream_exporter.scenes.projection import Float32Array
    from lanestream_exporter.scenes.render_target import RenderTarget
    from lanestream_exporter.scenes.surface import Color


@dataclass(frozen=True)
class Ridge:
    """A silhouette along the horizon: smooth ones look like hills, rough ones like woods."""

    height: float  # mean height above the horizon, as a share of the focal length
    relief: float  # sigma of its outline, as a share of the focal length
    smoothness: float  # texels of outline noise per radian: small for hills, large for tree tops
    color: Color
    texture: float  # strength of the texture inside
    seed: int


@dataclass(frozen=True)
class Backdrop:
    """The sky from the top of the image to the horizon, and ridges from far to near."""

    zenith: Color
    skyline: Color
    clouds: float  # share of the sky, 0 to 1
    ridges: tuple[Ridge, ...]
    seed: int


def draw_backdrop(target: RenderTarget, backdrop: Backdrop, bottom: int) -> None:
    """Draws sky and ridges into the rows above `bottom`; they rotate with the vehicle's bearing."""
    if bottom <= 0:
        return
    sky = _sky(target, backdrop, bottom)
    for ridge in backdrop.ridges:
        _draw_ridge(target, ridge, sky)
    cv2.convertScaleAbs(sky, target.image[:bottom], alpha=255.0)


def _sky(target: RenderTarget, backdrop: Backdrop, bottom: int) -> Float32Array:
    camera = target.projection.camera
    rise = (camera.horizon - np.arange(bottom)) / (0.45 * camera.focal)
    elevation = np.clip(rise, 0.0, 1.0).astype(np.float32)[:, None]
    low, high = (np.array(color, np.float32) for color in (backdrop.skyline, backdrop.zenith))
    rows = low + np.sqrt(elevation) * (high - low)
    sky = np.repeat(rows[:, None, :], camera.width, axis=1)
    if backdrop.clouds > 0.0:
        noise = _angular_noise(target, bottom, (70.0, 260.0), backdrop.seed)
        cover = np.clip((noise - 1.6 + 3.2 * backdrop.clouds) * 0.6, 0.0, 0.92)[..., None]
        white = np.float32(max(backdrop.skyline)) * (1.0 - 0.08 * np.clip(noise, 0.0, 2.0))[..., None]
        sky += cover * (white - sky)
    return np.asarray(sky * np.float32(target.light.glow), dtype=np.float32)


def _angular_noise(target: RenderTarget, bottom: int, density: tuple[float, float], seed: int) -> Float32Array:
    """Returns noise (bottom, width) fixed to directions. `density`: texels per radian, horizontal and vertical."""
    camera = target.projection.camera
    shift = np.random.default_rng(seed).random(2) * TILE
    across = (np.arange(camera.width) - camera.center) / camera.focal - target.projection.bearing
    up = (camera.horizon - np.arange(bottom)) / camera.focal
    columns = np.mod(across * density[0] + shift[0], TILE).astype(np.float32)
    rows = np.mod(up * density[1] + shift[1], TILE).astype(np.float32)
    grid = np.broadcast_to(columns, (bottom, camera.width)), np.broadcast_to(rows[:, None], (bottom, camera.width))
    maps = [np.ascontiguousarray(part) for part in grid]
    noise = cv2.remap(noise_tiles().cloud, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(noise, dtype=np.float32)


def _draw_ridge(target: RenderTarget, ridge: Ridge, sky: Float32Array) -> None:
    camera, bottom = target.projection.camera, len(sky)
    outline = _outline(target, ridge)
    tops = camera.horizon - camera.focal * (ridge.height + ridge.relief * outline)
    first = int(np.clip(tops.min() - 1, 0, bottom))
    if first >= bottom:
        return
    region = sky[first:]
    rows = np.arange(first, bottom, dtype=np.float32)[:, None]
    cover = np.clip(rows - tops.astype(np.float32) + 0.5, 0.0, 1.0)[..., None]
    noise = _angular_noise(target, bottom, (500.0, 900.0), ridge.seed + 1)[first:]
    shade = np.clip(1.0 + np.float32(ridge.texture) * noise, 0.1, 2.0)[..., None] * np.float32(target.light.glow)
    region += cover * (shade * np.array(ridge.color, np.float32) - region)


def _outline(target: RenderTarget, ridge: Ridge) -> Float32Array:
    """Returns the outline of the ridge (width,) with zero mean and about unit standard deviation."""
    camera = target.projection.camera
    row = np.random.default_rng(ridge.seed).integers(TILE)
    across = (np.arange(camera.width) - camera.center) / camera.focal - target.projection.bearing
    texels = noise_tiles().cloud[row]
    outline = np.interp(across * ridge.smoothness, np.arange(TILE), texels, period=TILE)
    return np.asarray(outline, dtype=np.float32)
