"""What may happen to a picture between a road and the network: to the strip's place, to the light, in the camera.

The first published tracker's list (flip, blur and sharpen, darken, shear with noise or lost pixels) and what roads and
cameras do beyond it. OpenCV does the work, picture by picture: a batch costs a tenth of what it does in tensors.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream_exporter.training.config import Augmentation, Light

Pixels = NDArray[np.float32]

_STEEPEST = np.tan(np.deg2rad(25.0))


def augmented(
    patches: NDArray[np.uint8], labels: NDArray[np.int64], shares: Augmentation, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """RGB patches (N, H, W, 3), each with its own accidents, which leave its label (N,) true."""
    moved = (_moved(patch, bool(label), shares, rng) for patch, label in zip(patches, labels, strict=True))
    return np.stack([photographed(patch, shares.light, rng) for patch in moved])


def photographed(image: NDArray[np.uint8], light: Light, rng: np.random.Generator) -> NDArray[np.uint8]:
    """An RGB picture (H, W, 3) in another light and through another camera; nothing in it moves."""
    pixels: Pixels = image.astype(np.float32)
    if _happens(light.exposure, rng):
        pixels = np.asarray(cv2.LUT(image, _exposure(rng)), dtype=np.float32)
    for share, accident in _accidents(light):
        if _happens(share, rng):
            pixels = accident(pixels, rng)
    taken = np.clip(pixels, 0.0, 255.0).astype(np.uint8)
    return _compressed(taken, rng) if _happens(light.jpeg, rng) else taken


def _accidents(light: Light) -> tuple[tuple[float, Callable[[Pixels, np.random.Generator], Pixels]], ...]:
    return (
        (light.night, _by_headlights),
        (light.shadow, _shaded),
        (light.glare, _dazzled),
        (light.rain, _rained_on),
        (light.blur, _blurred),
        (light.grain, _grained),
        (light.lost, _with_lost_pixels),
    )


def _happens(share: float, rng: np.random.Generator) -> bool:
    return bool(rng.random() < share)


def _moved(
    patch: NDArray[np.uint8], is_true: bool, shares: Augmentation, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Mirrors the patch; moves its top and its bottom sideways as candidates err; tilts false ones wholly."""
    if _happens(shares.flip, rng):
        patch = np.ascontiguousarray(patch[:, ::-1])
    height, width = patch.shape[:2]
    top, bottom = width * rng.uniform(-shares.jitter, shares.jitter, 2)
    if not is_true and _happens(shares.shear, rng):
        tilt = rng.uniform(-_STEEPEST, _STEEPEST) * height / 2.0
        top, bottom = top - tilt, bottom + tilt
    if top == bottom == 0.0:
        return patch
    matrix = np.array([[1.0, (bottom - top) / (height - 1), top], [0.0, 1.0, 0.0]])
    moved = cv2.warpAffine(patch, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, dtype=np.uint8)


def _exposure(rng: np.random.Generator) -> Pixels:
    """A table (1, 256, 3) from levels to levels: gamma, gain with a cast of colour, and a veil or its opposite."""
    gamma, gain = np.exp(rng.uniform(-0.4, 0.4)), np.exp(rng.uniform(-0.9, 0.4))
    levels = (np.arange(256.0) / 255.0)[:, None] ** gamma * gain * rng.uniform(0.9, 1.1, 3)
    return np.asarray((levels + rng.uniform(-0.05, 0.08)) * 255.0, dtype=np.float32)[None]


def _by_headlights(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """Night: a cone of light from the bottom that the far road falls out of, and dark beside it."""
    height, width = pixels.shape[:2]
    near = np.linspace(0.0, 1.0, height) ** rng.uniform(0.5, 2.0)
    across = _bell(width, rng.uniform(0.2, 0.8), rng.uniform(0.3, 0.8))
    ambient = rng.uniform(0.06, 0.25)
    return _times(pixels, rng.uniform(0.5, 1.1) * (ambient + (1.0 - ambient) * np.outer(near, across)))


def _shaded(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """A shadow on one side of a straight edge, hard or soft."""
    height, width = pixels.shape[:2]
    turn, where = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.8, 0.8)
    y, x = np.linspace(-1.0, 1.0, height)[:, None], np.linspace(-1.0, 1.0, width)
    depth = (x * np.cos(turn) + y * np.sin(turn) - where) / rng.uniform(0.01, 0.1)
    return _times(pixels, 1.0 - rng.uniform(0.2, 0.75) * np.clip(depth, 0.0, 1.0))


def _dazzled(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """A low sun or oncoming lights: a veil over everything, brightest somewhere."""
    height, width = pixels.shape[:2]
    centre, spread = rng.uniform(0.0, 1.0, 2), rng.uniform(0.1, 0.5, 2)
    spot = np.outer(_bell(height, centre[0], spread[0]), _bell(width, centre[1], spread[1]))
    veil = rng.uniform(0.0, 50.0) + rng.uniform(30.0, 130.0) * spot
    return _plus(pixels, veil)


def _rained_on(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """Bright streaks that all fall one way, and the haze of a wet pane."""
    height, width = pixels.shape[:2]
    layer = np.zeros((height, width), np.uint8)
    slant, length = rng.uniform(-0.4, 0.4), rng.uniform(0.04, 0.2) * height
    for x, y in rng.uniform(0.0, (width, height), (int(rng.integers(15, 80)), 2)):
        end = (round(x + slant * length), round(y + length))
        cv2.line(layer, (round(x), round(y)), end, int(rng.integers(60, 220)), 1, cv2.LINE_AA)
    veiled = cv2.addWeighted(pixels, rng.uniform(0.6, 1.0), pixels, 0.0, rng.uniform(0.0, 40.0))
    return _plus(np.asarray(veiled, np.float32), cv2.blur(layer, (3, 3)) * rng.uniform(0.3, 0.9))


def _blurred(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """From a blur to an over-sharpened picture: towards the local mean or away from it."""
    mean = cv2.GaussianBlur(pixels, (5, 5), rng.uniform(0.4, 1.5))
    amount = rng.uniform(-0.6, 1.0)
    return np.asarray(cv2.addWeighted(pixels, 1.0 - amount, mean, amount, 0.0), dtype=np.float32)


def _grained(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    grain = rng.standard_normal(pixels.shape[:2], dtype=np.float32)
    return _plus(pixels, grain * np.float32(rng.uniform(0.0, 13.0)))


def _with_lost_pixels(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    kept = rng.random(pixels.shape[:2], dtype=np.float32) >= rng.uniform(0.0, 0.02)
    return _times(pixels, kept)


def _compressed(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Through a JPEG as poor as cameras stream them."""
    encoded = cv2.imencode(".jpg", image[:, :, ::-1], (cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(20, 75))))[1]
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB), dtype=np.uint8)


def _bell(size: int, centre: float, spread: float) -> NDArray[np.float64]:
    """A bell curve over `size` pixels; `centre` and `spread` are shares of the size."""
    return np.asarray(np.exp(-0.5 * ((np.linspace(0.0, 1.0, size) - centre) / spread) ** 2))


def _times(pixels: Pixels, factor: NDArray[np.floating | np.bool_]) -> Pixels:
    """The pixels (H, W, 3) times a factor (H, W)."""
    return np.asarray(cv2.multiply(pixels, cv2.cvtColor(factor.astype(np.float32), cv2.COLOR_GRAY2RGB)))


def _plus(pixels: Pixels, light: NDArray[np.floating]) -> Pixels:
    """The pixels (H, W, 3) plus a light (H, W)."""
    return np.asarray(cv2.add(pixels, cv2.cvtColor(light.astype(np.float32), cv2.COLOR_GRAY2RGB)))
