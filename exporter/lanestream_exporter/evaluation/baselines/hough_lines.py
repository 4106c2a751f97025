"""Baseline: OpenCV's Canny and HoughLinesP, then one averaged line per side, as taught in introductory courses."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lanestream.road.curve import Curve, FloatArray
from lanestream.road.view import Image
from lanestream_exporter.evaluation.boundaries import ReportedBoundary

_WIDTH = 960  # the image width that the common settings are meant for


@dataclass(frozen=True)
class HoughLinesBaseline:
    """Finds edges in a trapezoid below `top` (share of the height), then segments, then a mean line per side."""

    name: str = "baseline: Canny + HoughLinesP"
    top: float = 0.6
    canny: tuple[int, int] = (50, 150)
    votes: int = 20
    shortest: float = 20.0
    gap: float = 100.0
    slopes: tuple[float, float] = (0.3, 10.0)

    def detect(self, image: Image) -> tuple[ReportedBoundary, ...]:
        """Returns the ego boundaries of a BGR image (H, W, 3), at most two."""
        scale = _WIDTH / image.shape[1]
        small = cv2.resize(image, (_WIDTH, round(image.shape[0] * scale)), interpolation=cv2.INTER_AREA)
        segments = self._segments(np.asarray(small, dtype=np.uint8))
        sides = [self._line(segments, side) for side in (-1, 1)]
        rows = self.top * image.shape[0], image.shape[0] - 1.0
        return tuple(
            ReportedBoundary(_curve(line / np.array([1.0, scale]), image.shape[1]), *rows, side)
            for side, line in zip((-1, 1), sides, strict=True)
            if line is not None
        )

    def _segments(self, image: Image) -> FloatArray:
        """Returns the segments (N, 4) inside the trapezoid as x1, y1, x2, y2."""
        height, width = image.shape[:2]
        gray = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (5, 5), 0)
        corners = [(0, height), (0.45 * width, self.top * height), (0.55 * width, self.top * height), (width, height)]
        mask = np.zeros_like(gray)
        cv2.fillPoly(mask, [np.array(corners, np.int32)], (255,))
        edges = cv2.bitwise_and(cv2.Canny(gray, *self.canny), mask)
        lines = cv2.HoughLinesP(edges, 1.0, np.pi / 180.0, self.votes, None, self.shortest, self.gap)
        return np.zeros((0, 4)) if lines is None else np.asarray(lines, dtype=float).reshape(-1, 4)

    def _line(self, segments: FloatArray, side: int) -> FloatArray | None:
        """Returns (dx/dy, x at y = 0) of a side's mean line, weighted by segment length; None without segments."""
        x1, y1, x2, y2 = segments.T
        steep = np.abs(y2 - y1) / np.maximum(np.abs(x2 - x1), 1e-6)
        outward = np.sign((x2 - x1) * (y2 - y1)) == side
        selected = outward & (steep >= self.slopes[0]) & (steep <= self.slopes[1])
        selected &= ((x1 + x2) / 2.0 - _WIDTH / 2.0) * side > 0.0
        if not selected.any():
            return None
        dx_dy = (x2 - x1)[selected] / (y2 - y1)[selected]
        at_zero = x1[selected] - dx_dy * y1[selected]
        lengths = np.hypot(x2 - x1, y2 - y1)[selected]
        return np.asarray(np.average(np.stack([dx_dy, at_zero], axis=1), axis=0, weights=lengths))


def _curve(line: FloatArray, width: int) -> Curve:
    """Returns a straight curve whose horizon is where the line reaches the center column of the image."""
    dx_dy, at_zero = float(line[0]), float(line[1])
    center = 0.5 * width
    return Curve((center - at_zero) / dx_dy, (center, dx_dy, 0.0))
