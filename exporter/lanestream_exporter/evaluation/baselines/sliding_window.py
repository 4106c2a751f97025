"""Baseline: a bird's-eye view, windows sliding up from the peaks of a histogram, and one polynomial per side."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lanestream.road.curve import Curve, FloatArray
from lanestream.road.view import Image
from lanestream_exporter.evaluation.boundaries import ReportedBoundary

_SIZE = 400  # the bird's-eye view is square


@dataclass(frozen=True)
class SlidingWindowBaseline:
    """Follows saturated pixels and vertical edges in a bird's-eye view with sliding windows.

    The trapezoid of road in the bird's-eye view extends from `top` to the bottom row, where it is as wide as the image;
    its sides meet at `horizon` (shares of the height). Each of the `windows` windows extends `margin` pixels of the
    bird's-eye view to either side, and recenters if it contains at least `enough` pixels.
    """

    name: str = "baseline: bird's-eye sliding window"
    horizon: float = 0.4
    top: float = 0.62
    windows: int = 9
    margin: int = 40
    enough: int = 20

    def detect(self, image: Image) -> tuple[ReportedBoundary, ...]:
        """Returns the ego boundaries of a BGR image (H, W, 3), at most two."""
        height, width = image.shape[:2]
        small = cv2.resize(image, (640, round(height * 640 / width)), interpolation=cv2.INTER_AREA)
        birds_eye = self._birds_eye(_paint(np.asarray(small, dtype=np.uint8)))
        histogram = birds_eye[_SIZE // 2 :].sum(axis=0)
        half = _SIZE // 2
        starts = int(np.argmax(histogram[:half])), half + int(np.argmax(histogram[half:]))
        reports = []
        for side, start in zip((-1, 1), starts, strict=True):
            polynomial = self._follow(birds_eye, start)
            if polynomial is not None:
                curve, top = self._curve(polynomial, width, height), self.top * height
                reports.append(ReportedBoundary(curve, top, height - 1.0, side, farthest=top))
        return tuple(reports)

    def _birds_eye(self, paint: Image) -> Image:
        height, width = paint.shape
        half = 0.5 * width * (self.top - self.horizon) / (1.0 - self.horizon)
        upper = [(0.5 * width - half, self.top * height), (0.5 * width + half, self.top * height)]
        source = np.array([*upper, (width, height), (0, height)], np.float32)
        target = np.array([(0, 0), (_SIZE, 0), (_SIZE, _SIZE), (0, _SIZE)], np.float32)
        matrix = cv2.getPerspectiveTransform(source, target)
        return np.asarray(cv2.warpPerspective(paint, matrix, (_SIZE, _SIZE)), dtype=np.uint8)

    def _follow(self, birds_eye: Image, start: int) -> FloatArray | None:
        """Returns the polynomial x(y) (3,) through the pixels of a side; None if the windows caught too few."""
        y, x = np.nonzero(birds_eye)
        step, center = _SIZE // self.windows, float(start)
        caught = np.zeros(len(x), bool)
        for low in range(_SIZE, _SIZE - step * self.windows, -step):
            inside = (y < low) & (y >= low - step) & (np.abs(x - center) < self.margin)
            caught |= inside
            if inside.sum() >= self.enough:
                center = float(x[inside].mean())
        spread = np.ptp(y[caught]) if caught.any() else 0
        if caught.sum() < self.windows * self.enough or spread < 0.4 * _SIZE:
            return None
        return np.asarray(np.polyfit(y[caught], x[caught], 2))

    def _curve(self, polynomial: FloatArray, width: int, height: int) -> Curve:
        """Returns the polynomial in the image; in perspective, a parabola on the ground is exactly a `Curve`."""
        horizon, bottom, top = self.horizon * height, float(height), self.top * height
        rows = np.linspace(top, bottom, 3)
        u, near, far = rows - horizon, bottom - horizon, top - horizon
        y = _SIZE * (1.0 / far - 1.0 / u) / (1.0 / far - 1.0 / near)
        across = (np.polyval(polynomial, y) / _SIZE - 0.5) * width * u / near
        return Curve.through(horizon, rows, 0.5 * width + across)


def _paint(image: Image) -> Image:
    """Returns a mask (H, W): 255 where a pixel is saturated or its lightness changes horizontally, else 0."""
    hls = cv2.cvtColor(image, cv2.COLOR_BGR2HLS)
    change = np.abs(cv2.Sobel(hls[..., 1], cv2.CV_32F, 1, 0))
    change *= 255.0 / max(float(change.max()), 1.0)
    paint = ((change >= 20.0) & (change <= 100.0)) | (hls[..., 2] >= 170)
    return np.asarray(paint * 255, dtype=np.uint8)
