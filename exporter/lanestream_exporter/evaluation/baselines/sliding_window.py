"""Peer: a bird's-eye view, windows that slide up from a histogram's peaks, a polynomial a side, as courses teach it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lanestream.road.curve import Curve, FloatArray
from lanestream.road.view import Image
from lanestream_exporter.evaluation.boundaries import Found

_SIZE = 400  # the bird's-eye view is square


@dataclass(frozen=True)
class SlidingWindowPeer:
    """Bright and saturated pixels and vertical edges, seen from above, followed by windows.

    The trapezium of road that is seen from above reaches from `top` to the bottom row and is as wide as the image
    there; its sides meet at `horizon` (shares of the height). `windows` windows reach `margin` to either side and move
    where `enough` pixels are (margin and enough in pixels of the view from above).
    """

    name: str = "peer: bird's-eye sliding window"
    horizon: float = 0.4
    top: float = 0.62
    windows: int = 9
    margin: int = 40
    enough: int = 20

    def find(self, image: Image) -> tuple[Found, ...]:
        """The ego boundaries of a BGR image (H, W, 3), none to two."""
        height, width = image.shape[:2]
        small = cv2.resize(image, (640, round(height * 640 / width)), interpolation=cv2.INTER_AREA)
        above = self._from_above(_paint(np.asarray(small, dtype=np.uint8)))
        histogram = above[_SIZE // 2 :].sum(axis=0)
        half = _SIZE // 2
        starts = int(np.argmax(histogram[:half])), half + int(np.argmax(histogram[half:]))
        found = []
        for side, start in zip((-1, 1), starts, strict=True):
            polynomial = self._follow(above, start)
            if polynomial is not None:
                curve, top = self._curve(polynomial, width, height), self.top * height
                found.append(Found(curve, top, height - 1.0, side, farthest=top))
        return tuple(found)

    def _from_above(self, paint: Image) -> Image:
        height, width = paint.shape
        half = 0.5 * width * (self.top - self.horizon) / (1.0 - self.horizon)
        upper = [(0.5 * width - half, self.top * height), (0.5 * width + half, self.top * height)]
        source = np.array([*upper, (width, height), (0, height)], np.float32)
        target = np.array([(0, 0), (_SIZE, 0), (_SIZE, _SIZE), (0, _SIZE)], np.float32)
        matrix = cv2.getPerspectiveTransform(source, target)
        return np.asarray(cv2.warpPerspective(paint, matrix, (_SIZE, _SIZE)), dtype=np.uint8)

    def _follow(self, above: Image, start: int) -> FloatArray | None:
        """The polynomial x(y) (3,) through the pixels of a side; None where windows caught too few."""
        y, x = np.nonzero(above)
        step, centre = _SIZE // self.windows, float(start)
        caught = np.zeros(len(x), bool)
        for low in range(_SIZE, _SIZE - step * self.windows, -step):
            inside = (y < low) & (y >= low - step) & (np.abs(x - centre) < self.margin)
            caught |= inside
            if inside.sum() >= self.enough:
                centre = float(x[inside].mean())
        spread = np.ptp(y[caught]) if caught.any() else 0
        if caught.sum() < self.windows * self.enough or spread < 0.4 * _SIZE:
            return None
        return np.asarray(np.polyfit(y[caught], x[caught], 2))

    def _curve(self, polynomial: FloatArray, width: int, height: int) -> Curve:
        """The polynomial in the image: seen in perspective, a parabola of the ground is exactly a `Curve`."""
        horizon, bottom, top = self.horizon * height, float(height), self.top * height
        rows = np.linspace(top, bottom, 3)
        u, near, far = rows - horizon, bottom - horizon, top - horizon
        seen_at = _SIZE * (1.0 / far - 1.0 / u) / (1.0 / far - 1.0 / near)
        across = (np.polyval(polynomial, seen_at) / _SIZE - 0.5) * width * u / near
        return Curve.through(horizon, rows, 0.5 * width + across)


def _paint(image: Image) -> Image:
    """255 where a pixel is saturated or its lightness changes from left to right, else 0; (H, W)."""
    hls = cv2.cvtColor(image, cv2.COLOR_BGR2HLS)
    change = np.abs(cv2.Sobel(hls[..., 1], cv2.CV_32F, 1, 0))
    change *= 255.0 / max(float(change.max()), 1.0)
    paint = ((change >= 20.0) & (change <= 100.0)) | (hls[..., 2] >= 170)
    return np.asarray(paint * 255, dtype=np.uint8)
