"""Augmentation: patches are flipped and moved, and images are corrupted as light and cameras corrupt them.

It extends the list of the first published tracker (flip, blur and sharpen, darken, shear with noise or lost pixels).
OpenCV works image by image: a batch takes a tenth of the time that tensor operations take.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from lanestream_exporter.toml_files import Section, Share

Pixels = NDArray[np.float32]

_MAX_TILT = np.tan(np.deg2rad(25.0))


class Corruptions(Section):
    """How often light and camera corrupt an image, as shares of all images."""

    exposure: Share = 1.0
    shadow: Share = 0.33
    glare: Share = 0.08
    night: Share = 0.08
    rain: Share = 0.08
    blur: Share = 1.0
    grain: Share = 1.0
    lost: Share = 0.05
    jpeg: Share = 0.15


class Augmentation(Section):
    """How patches are varied. `flip` is a share of all patches and `shear` a share of the false ones.

    `jitter` is the largest sideways move of the top and the bottom of a patch, as a share of its width.
    """

    flip: Share = 0.5
    jitter: Annotated[float, Field(ge=0.0, le=0.05)] = 0.013
    shear: Share = 0.1
    corruptions: Corruptions = Corruptions()


def augmented(
    patches: NDArray[np.uint8], is_boundary: NDArray[np.bool_], shares: Augmentation, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Returns RGB patches (N, H, W, 3), each varied on its own so that it still shows a boundary (N,) or not."""
    moved = (_move(patch, shows, shares, rng) for patch, shows in zip(patches, is_boundary.tolist(), strict=True))
    return np.stack([corrupted(patch, shares.corruptions, rng) for patch in moved])


def corrupted(image: NDArray[np.uint8], shares: Corruptions, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Returns an RGB image (H, W, 3) in different light and from a different camera; nothing in it moves."""
    pixels: Pixels = image.astype(np.float32)
    if _occurs(shares.exposure, rng):
        pixels = np.asarray(cv2.LUT(image, _exposure(rng)), dtype=np.float32)
    for share, corrupt in _corruptions(shares):
        if _occurs(share, rng):
            pixels = corrupt(pixels, rng)
    result = np.clip(pixels, 0.0, 255.0).astype(np.uint8)
    return _jpeg(result, rng) if _occurs(shares.jpeg, rng) else result


def _corruptions(shares: Corruptions) -> tuple[tuple[float, Callable[[Pixels, np.random.Generator], Pixels]], ...]:
    return (
        (shares.night, _night),
        (shares.shadow, _shadow),
        (shares.glare, _glare),
        (shares.rain, _rain),
        (shares.blur, _blur),
        (shares.grain, _grain),
        (shares.lost, _lost_pixels),
    )


def _occurs(share: float, rng: np.random.Generator) -> bool:
    return bool(rng.random() < share)


def _move(patch: NDArray[np.uint8], is_true: bool, shares: Augmentation, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Flips the patch, moves its top and bottom sideways like an inaccurate candidate, and shears false patches."""
    if _occurs(shares.flip, rng):
        patch = np.ascontiguousarray(patch[:, ::-1])
    height, width = patch.shape[:2]
    top, bottom = width * rng.uniform(-shares.jitter, shares.jitter, 2)
    if not is_true and _occurs(shares.shear, rng):
        tilt = rng.uniform(-_MAX_TILT, _MAX_TILT) * height / 2.0
        top, bottom = top - tilt, bottom + tilt
    if top == bottom == 0.0:
        return patch
    matrix = np.array([[1.0, (bottom - top) / (height - 1), top], [0.0, 1.0, 0.0]])
    moved = cv2.warpAffine(patch, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, dtype=np.uint8)


def _exposure(rng: np.random.Generator) -> Pixels:
    """Returns a lookup table (1, 256, 3): gamma, a gain with a color cast, and a brightness offset."""
    gamma, gain = np.exp(rng.uniform(-0.4, 0.4)), np.exp(rng.uniform(-0.9, 0.4))
    levels = (np.arange(256.0) / 255.0)[:, None] ** gamma * gain * rng.uniform(0.9, 1.1, 3)
    return np.asarray((levels + rng.uniform(-0.05, 0.08)) * 255.0, dtype=np.float32)[None]


def _night(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """Night: headlights that light a cone from the bottom; the far road and the sides are dark."""
    height, width = pixels.shape[:2]
    near = np.linspace(0.0, 1.0, height) ** rng.uniform(0.5, 2.0)
    across = _bell(width, rng.uniform(0.2, 0.8), rng.uniform(0.3, 0.8))
    ambient = rng.uniform(0.06, 0.25)
    return _times(pixels, rng.uniform(0.5, 1.1) * (ambient + (1.0 - ambient) * np.outer(near, across)))


def _shadow(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """A shadow on one side of a straight edge, hard or soft."""
    height, width = pixels.shape[:2]
    angle, offset = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.8, 0.8)
    y, x = np.linspace(-1.0, 1.0, height)[:, None], np.linspace(-1.0, 1.0, width)
    distance = (x * np.cos(angle) + y * np.sin(angle) - offset) / rng.uniform(0.01, 0.1)
    return _times(pixels, 1.0 - rng.uniform(0.2, 0.75) * np.clip(distance, 0.0, 1.0))


def _glare(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """A low sun or oncoming headlights: haze over the whole image and a bright spot."""
    height, width = pixels.shape[:2]
    center, spread = rng.uniform(0.0, 1.0, 2), rng.uniform(0.1, 0.5, 2)
    spot = np.outer(_bell(height, center[0], spread[0]), _bell(width, center[1], spread[1]))
    haze = rng.uniform(0.0, 50.0) + rng.uniform(30.0, 130.0) * spot
    return _plus(pixels, haze)


def _rain(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """Parallel bright streaks and the haze of a wet windshield."""
    height, width = pixels.shape[:2]
    layer = np.zeros((height, width), np.uint8)
    slant, length = rng.uniform(-0.4, 0.4), rng.uniform(0.04, 0.2) * height
    for x, y in rng.uniform(0.0, (width, height), (int(rng.integers(15, 80)), 2)):
        end = (round(x + slant * length), round(y + length))
        cv2.line(layer, (round(x), round(y)), end, int(rng.integers(60, 220)), 1, cv2.LINE_AA)
    hazy = cv2.addWeighted(pixels, rng.uniform(0.6, 1.0), pixels, 0.0, rng.uniform(0.0, 40.0))
    return _plus(np.asarray(hazy, np.float32), cv2.blur(layer, (3, 3)) * rng.uniform(0.3, 0.9))


def _blur(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """Blurs towards the local mean, or sharpens away from it."""
    mean = cv2.GaussianBlur(pixels, (5, 5), rng.uniform(0.4, 1.5))
    amount = rng.uniform(-0.6, 1.0)
    return np.asarray(cv2.addWeighted(pixels, 1.0 - amount, mean, amount, 0.0), dtype=np.float32)


def _grain(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    grain = rng.standard_normal(pixels.shape[:2], dtype=np.float32)
    return _plus(pixels, grain * np.float32(rng.uniform(0.0, 13.0)))


def _lost_pixels(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    kept = rng.random(pixels.shape[:2], dtype=np.float32) >= rng.uniform(0.0, 0.02)
    return _times(pixels, kept)


def _jpeg(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Compresses to a JPEG of the quality that cameras stream."""
    encoded = cv2.imencode(".jpg", image[:, :, ::-1], (cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(20, 75))))[1]
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB), dtype=np.uint8)


def _bell(size: int, center: float, spread: float) -> NDArray[np.float64]:
    """Returns a Gaussian over `size` pixels; `center` and `spread` are shares of the size."""
    return np.asarray(np.exp(-0.5 * ((np.linspace(0.0, 1.0, size) - center) / spread) ** 2))


def _times(pixels: Pixels, factor: NDArray[np.floating | np.bool_]) -> Pixels:
    """Returns the pixels (H, W, 3) times a factor (H, W)."""
    return np.asarray(cv2.multiply(pixels, cv2.cvtColor(factor.astype(np.float32), cv2.COLOR_GRAY2RGB)))


def _plus(pixels: Pixels, light: NDArray[np.floating]) -> Pixels:
    """Returns the pixels (H, W, 3) plus a brightness (H, W)."""
    return np.asarray(cv2.add(pixels, cv2.cvtColor(light.astype(np.float32), cv2.COLOR_GRAY2RGB)))
