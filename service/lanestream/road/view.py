"""Images and the part of them that can be road: resizing, rows below the horizon, the rows in which a curve is visible.

All resizing of coordinates goes through `Scaling`. Pixel centers are at integers, so a resize by s maps x to
s (x + 0.5) - 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from lanestream.road.curve import Curve, Curves, FloatArray

Image = NDArray[np.uint8]
T = TypeVar("T", float, FloatArray)

# Detectors and trackers work on images of this width, so that lengths in pixels mean the same for every camera.
WORKING_WIDTH: Final = 640

# Nearer to the horizon than this fraction of the road's rows a lane is a few pixels wide, and all lines look alike.
FARTHEST_VISIBLE: Final = 0.1

# Lanes are 2.5 to 4.5 m wide and cameras 1 to 2.4 m high. These are the usual width and its limits in columns per row
# offset, which equal meters over the camera's height.
USUAL_LANE_WIDTH: Final = 2.4
LANE_WIDTHS: Final = (1.1, 4.5)

# Rows in which visibility is tested, as shares of the way from the bottom to the farthest row.
_TESTED: Final = np.linspace(0.0, 1.0, 65)
_INDICES: Final = np.arange(len(_TESTED))


@dataclass(frozen=True)
class Scaling:
    """A uniform resize from image pixels to working pixels; `factor` is the working size over the image size."""

    factor: float

    @classmethod
    def to_working_width(cls, width: int) -> Scaling:
        """Returns the scaling of an image `width` pixels wide to its working image."""
        return cls(WORKING_WIDTH / width)

    def to_working(self, value: T) -> T:
        """Converts image columns or rows to working pixels."""
        return (value + 0.5) * self.factor - 0.5

    def to_image(self, value: T) -> T:
        """Converts working columns or rows to image pixels."""
        return (value + 0.5) / self.factor - 0.5

    def curve_to_image(self, curve: Curve) -> Curve:
        """Converts a curve from working to image pixels."""
        v, b, k = curve.coefficients
        return Curve(self.to_image(curve.horizon), (self.to_image(v), b, k / self.factor**2))

    def curve_to_working(self, curve: Curve) -> Curve:
        """Converts a curve from image to working pixels."""
        v, b, k = curve.coefficients
        return Curve(self.to_working(curve.horizon), (self.to_working(v), b, k * self.factor**2))

    def covariance_to_image(self, covariance: FloatArray) -> FloatArray:
        """Converts the covariance (3, 3) of a curve's coefficients from working to image pixels."""
        by = np.array([1.0 / self.factor, 1.0, 1.0 / self.factor**2])
        return covariance * np.outer(by, by)


@dataclass(frozen=True)
class RoadView:
    """The part of an image that can be road: everything below the horizon. Sizes and rows are in its pixels.

    The horizon of a camera that looks down may be above the image, at a negative row.
    """

    width: int
    height: int
    horizon: float

    @property
    def bottom(self) -> float:
        """The lowest row."""
        return self.height - 1.0

    @property
    def depth(self) -> float:
        """The number of rows from the horizon to the bottom: the scale of everything on the road."""
        return self.bottom - self.horizon

    @property
    def middle(self) -> float:
        """The middle column, where a camera in the middle of its lane is."""
        return (self.width - 1) / 2.0

    def row_at(self, share: float) -> float:
        """Returns the row at `share` of the way from the horizon (0) to the bottom (1).

        If the horizon is above the image, the row may be negative.
        """
        return self.horizon + share * self.depth

    def highest_row(self, share: float) -> float:
        """Returns the highest row of the image that is at least `share` of the depth below the horizon."""
        return max(self.row_at(share), 0.0)

    def with_horizon(self, horizon: float) -> RoadView:
        """Returns the same image with another horizon."""
        return replace(self, horizon=horizon)


@dataclass(frozen=True)
class Spans:
    """The rows `top` (N,) to `bottom` (N,) in which N curves are visible, and `visible` (N,): at least two rows are."""

    top: FloatArray
    bottom: FloatArray
    visible: NDArray[np.bool_]

    def take(self, indices: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Spans:
        """Returns the spans at `indices`, or those that a mask (N,) or a slice selects."""
        return Spans(self.top[indices], self.bottom[indices], self.visible[indices])


def visible_spans(curves: Curves, view: RoadView, top_share: float = FARTHEST_VISIBLE) -> Spans:
    """Returns the rows in which each curve is inside the image and at least `top_share` of the depth below the horizon.

    If a curve leaves the image and comes back, the part nearest to the camera counts.
    """
    rows = view.bottom + (view.highest_row(top_share) - view.bottom) * _TESTED
    columns = curves.x(rows)
    inside = (columns >= 0.0) & (columns <= view.width - 1.0)
    first = inside.argmax(axis=1)
    left = ~inside & (first[:, None] < _INDICES)
    last = np.where(left.any(axis=1), left.argmax(axis=1), len(rows)) - 1
    top, bottom = rows[last], rows[first]
    # A curve that is entirely outside has the span of its first row only.
    return Spans(top, bottom, bottom - top >= 2.0)


def visible_rows(curve: Curve, view: RoadView, top_share: float = FARTHEST_VISIBLE) -> tuple[float, float] | None:
    """Returns the visible (top, bottom) rows of one curve as `visible_spans` does, or None if it is not visible."""
    spans = visible_spans(Curves.of([curve]), view, top_share)
    return (float(spans.top[0]), float(spans.bottom[0])) if spans.visible[0] else None
