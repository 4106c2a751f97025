"""The camera pipeline from scene to file: hood, reflections, glare, blur, exposure, noise, compression."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from lanestream_exporter.scenes.noise import TILE, noise_tiles

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lanestream.road.view import Image
    from lanestream_exporter.scenes.projection import Float32Array
    from lanestream_exporter.scenes.surface import Color


@dataclass(frozen=True)
class Hood:
    """The vehicle's own hood or dashboard along the bottom of the image."""

    height: float  # at the center, as a share of the image height
    droop: float  # drop at the sides, as a share of the image height
    color: Color
    shine: float  # share of the scene that it reflects

    def top(self, width: int, height: int) -> Float32Array:
        """Returns the row of its edge at every image column, (width,)."""
        across = np.linspace(-1.0, 1.0, width, dtype=np.float32)
        return np.asarray(height * (1.0 - self.height + self.droop * across**2), dtype=np.float32)


@dataclass(frozen=True)
class Glare:
    """A bright haze around the sun or a lamp; x and y as shares of the image width and height."""

    x: float
    y: float
    radius: float  # share of the width
    strength: float


@dataclass(frozen=True)
class Lens:
    """The effects of camera and windshield on the image."""

    exposure: float = 1.0
    gamma: float = 1.0
    cast: Color = (1.0, 1.0, 1.0)
    saturation: float = 1.0
    lift: float = 0.0  # brightness of black
    vignette: float = 0.0  # share of light lost in the corners
    defocus: float = 0.0  # sigma, pixels of a 640 pixel wide image
    shake: float = 0.0  # length of the motion blur, pixels of a 640 pixel wide image
    shake_angle: float = 90.0  # degrees; 90 is up and down
    noise: float = 0.0  # sigma, gray levels
    quality: int = 0  # of the JPEG compression; 0 for no compression
    reflection: float = 0.0  # strength of the reflections in the windshield
    glare: Glare | None = None
    hood: Hood | None = None
    seed: int = 0
    frame: int = 0  # index in a clip; each frame has its own sensor noise


def develop(image: Image, lens: Lens) -> Image:
    """Returns the image as recorded by the camera, (H, W, 3) uint8. The hood is drawn into `image` itself."""
    if lens.hood:
        _draw_hood(image, lens.hood)
    if lens.saturation != 1.0:
        image = _saturate(image, lens.saturation)
    image = _blur(image, lens)
    veil = _veil(image.shape[1], image.shape[0], lens)
    if veil is not None:
        image = np.asarray(cv2.add(image, veil), dtype=np.uint8)
    if lens.vignette > 0.0:
        image = _vignetted(image, lens.vignette)
    image = np.asarray(cv2.LUT(image, _tone_curve(lens)), dtype=np.uint8)
    if lens.noise > 0.0:
        image = _noisy(image, lens)
    return _compressed(image, lens.quality) if lens.quality else image


def _draw_hood(image: Image, hood: Hood) -> None:
    height, width = image.shape[:2]
    edge = hood.top(width, height)
    first = int(max(0.0, edge.min() - 1.0))
    region = image[first:].astype(np.float32)
    rows = np.arange(first, height, dtype=np.float32)[:, None]
    depth = np.clip(rows - edge + 0.5, 0.0, None)
    cover = np.minimum(depth, 1.0)[..., None]
    mirrored = cv2.blur(image[max(0, 2 * first - height) : first][::-1], (max(3, width // 40), 3)).astype(np.float32)
    body = np.array(hood.color, np.float32) * np.float32(255.0)
    falling = np.exp(-depth / (0.05 * height))[..., None] * np.float32(0.35) + np.float32(0.8)
    mirrored = mirrored[: len(region)]
    painted = np.broadcast_to(body * falling, region.shape).copy()
    painted[: len(mirrored)] += hood.shine * mirrored
    region += cover * (painted - region)
    image[first:] = np.clip(region, 0.0, 255.0).astype(np.uint8)


def _saturate(image: Image, saturation: float) -> Image:
    gray = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    return np.asarray(cv2.addWeighted(image, saturation, gray, 1.0 - saturation, 0.0), dtype=np.uint8)


def _blur(image: Image, lens: Lens) -> Image:
    scale = image.shape[1] / 640.0
    if lens.defocus * scale > 0.2:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), lens.defocus * scale), dtype=np.uint8)
    length = lens.shake * scale
    if length > 1.0:
        size = 2 * int(np.ceil(length / 2.0)) + 1
        kernel = np.zeros((size, size), np.float32)
        angle = np.radians(lens.shake_angle)
        tip = np.array([np.cos(angle), np.sin(angle)]) * length / 2.0
        center = (size - 1) / 2.0
        ends = np.round((center + np.stack([-tip, tip])) * 16).astype(int)
        cv2.line(kernel, ends[0].tolist(), ends[1].tolist(), (1.0,), 1, cv2.LINE_8, 4)
        kernel += kernel[::-1, ::-1]  # symmetric, so that the image does not shift
        image = np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), dtype=np.uint8)
    return image


def _veil(width: int, height: int, lens: Lens) -> Image | None:
    """Returns the light added by glare and reflections; smooth, so computed at an eighth of the resolution."""
    if lens.glare is None and lens.reflection <= 0.0:
        return None
    columns, rows = max(2, width // 8), max(2, height // 8)
    veil = np.zeros((rows, columns), np.float32)
    if lens.glare:
        x = (np.arange(columns, dtype=np.float32) / columns - lens.glare.x)[None, :]
        y = (np.arange(rows, dtype=np.float32) / rows - lens.glare.y)[:, None] * np.float32(height / width)
        squared = (x**2 + y**2) / np.float32(lens.glare.radius**2)
        veil += np.float32(255.0 * lens.glare.strength) / (1.0 + 4.0 * squared)
    if lens.reflection > 0.0:
        rng = np.random.default_rng(lens.seed)
        y, x = rng.integers(0, TILE - 96, 2)
        smooth = cv2.resize(noise_tiles().cloud[y : y + 48, x : x + 96], (columns, rows))
        lower = np.linspace(0.2, 1.0, rows, dtype=np.float32)[:, None]
        veil += np.float32(60.0 * lens.reflection) * np.clip(smooth + 0.5, 0.0, 2.0) * lower
    large = cv2.resize(np.clip(veil, 0.0, 255.0).astype(np.uint8), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.cvtColor(large, cv2.COLOR_GRAY2BGR), dtype=np.uint8)


def _vignetted(image: Image, strength: float) -> Image:
    height, width = image.shape[:2]
    x = np.linspace(-1.0, 1.0, max(2, width // 8), dtype=np.float32)[None, :]
    y = np.linspace(-1.0, 1.0, max(2, height // 8), dtype=np.float32)[:, None]
    gain = 255.0 * (1.0 - strength * (x**2 + y**2) / 2.0)
    large = cv2.resize(gain.astype(np.uint8), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.multiply(image, cv2.cvtColor(large, cv2.COLOR_GRAY2BGR), scale=1.0 / 255.0), dtype=np.uint8)


def _tone_curve(lens: Lens) -> NDArray[np.uint8]:
    """Returns a lookup table (1, 256, 3) for exposure, color cast, gamma and black level."""
    level = np.arange(256)[:, None] / 255.0 * lens.exposure * np.array(lens.cast)
    # A soft shoulder instead of a hard clip: bright paint on bright concrete keeps a little contrast.
    knee = 0.8
    soft = np.where(level > knee, knee + (1.0 - knee) * np.tanh((level - knee) / (1.0 - knee)), level)
    curve = lens.lift + (1.0 - lens.lift) * soft**lens.gamma
    return np.asarray(np.clip(curve * 255.0, 0.0, 255.0), dtype=np.uint8)[None]


def _noisy(image: Image, lens: Lens) -> Image:
    """Adds sensor noise: one random tile, repeated with a different offset for each channel."""
    rng = np.random.default_rng((lens.seed, lens.frame))
    height, width = image.shape[:2]
    grain = rng.standard_normal((256, 256), dtype=np.float32) * np.float32(lens.noise)
    tile = np.tile(np.round(grain).astype(np.int16), (2, 2))
    rows, columns = -(-height // 256), -(-width // 256)
    layers = []
    for _ in range(3):
        y, x = rng.integers(0, 256, 2)
        layers.append(np.tile(tile[y : y + 256, x : x + 256], (rows, columns))[:height, :width])
    return np.asarray(cv2.add(image, np.stack(layers, axis=-1), dtype=cv2.CV_8U), dtype=np.uint8)


def _compressed(image: Image, quality: int) -> Image:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)
