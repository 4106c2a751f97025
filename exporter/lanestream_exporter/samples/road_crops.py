"""Training samples of the regressor: road crops of frames, warped as other cameras and roads would show them.

On a flat road a boundary is x = v + b u + k / u with u = y - horizon. Another viewing direction changes v, another
lateral position of the camera changes b, a zoom scales x and u, and another curvature of the road changes k. Each is a
warp of the image, so one labeled frame yields many samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.ego_prior import UNKNOWN_HORIZONS
from lanestream.road.crops import FloatMap, RoadCropGeometry
from lanestream.road.curve import FloatArray
from lanestream.road.view import RoadView
from lanestream_exporter.samples.road_frames import RoadFrame

# The shares of the rows below the horizon at which errors are measured.
SHARES: Final = (1.0, 0.8, 0.62, 0.48, 0.37, 0.28, 0.21, 0.16, 0.12)

# Standard deviations of the curvature term, as shares of the rows below the horizon, and how often each is drawn.
# Highways have about a hundredth, mountain roads a tenth.
_CURVATURE_SIGMAS: Final = (0.012, 0.03, 0.08)
_CURVATURE_SHARES: Final = (0.6, 0.3, 0.1)

# Closer to the horizon than this share of the rows the curvature is not applied: it would tear the image apart.
_CURVED_FROM: Final = 0.05


@dataclass(frozen=True)
class RegressionTarget:
    """The true outputs of the regressor for a road crop.

    `columns` (2, S) are those of the left and the right boundary at `SHARES` of the rows below the true horizon, in
    image widths from the center; `known` (2, S) weighs them, 1 within a label; `presence` (2,) is 1, 0, or -1 if
    unknown; `road_edge` (2,) is 1 for an edge of the road, 0 for a marking, -1 if unknown or absent; `horizon` is its
    offset below the assumed horizon, as a share of the rows below that, or NaN without a road.
    """

    columns: NDArray[np.float32]
    known: NDArray[np.float32]
    presence: NDArray[np.float32]
    road_edge: NDArray[np.float32]
    horizon: float


@dataclass(frozen=True)
class Warp:
    """A change of the camera or the road.

    `pan` is in image widths, `side` in columns per row, `curvature` as a share of the rows below the horizon; `flipped`
    mirrors the image. `assumed` is the error of the horizon that the crop is cut with, as a share of those rows.
    """

    pan: float = 0.0
    side: float = 0.0
    zoom: float = 1.0
    curvature: float = 0.0
    assumed: float = 0.0
    flipped: bool = False

    @classmethod
    def random(cls, rng: np.random.Generator) -> Warp:
        """Returns a random warp, usually a small one: most cameras look ahead from within their lane."""
        horizon_unknown = rng.random() < 0.2
        return cls(
            pan=rng.normal(0.0, 0.06),
            side=rng.normal(0.0, 0.15),
            zoom=float(np.exp(rng.normal(0.0, 0.12))),
            curvature=rng.normal(0.0, rng.choice(_CURVATURE_SIGMAS, p=_CURVATURE_SHARES)),
            assumed=rng.uniform(-0.25, 0.25) if horizon_unknown else rng.normal(0.0, 0.02),
            flipped=bool(rng.random() < 0.5),
        )


def warped_road_crop(
    frame: RoadFrame, geometry: RoadCropGeometry, warp: Warp
) -> tuple[NDArray[np.uint8], RegressionTarget]:
    """Returns the road crop (size, size, 3) in RGB of a frame under `warp`, and its target."""
    view = RoadView(frame.width, frame.height, frame.horizon)
    assumed = RoadView(frame.width, frame.height, frame.horizon + warp.assumed * view.depth)
    columns, rows = geometry.grid(assumed)
    source_columns, source_rows = _source(columns, rows, view, warp)
    crop = cv2.remap(
        frame.image(), source_columns.astype(np.float32), source_rows.astype(np.float32),
        cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    rgb = np.asarray(cv2.cvtColor(crop, cv2.COLOR_BGR2RGB), dtype=np.uint8)
    return rgb, _target([_warped(lane, view, warp) for lane in frame.lanes], frame, view, assumed)


def plain_warp(frame: RoadFrame, known: bool) -> Warp:
    """Returns no warp, with the true horizon if `known`, else the closest of the horizons tried on a new camera."""
    depth = frame.height - 1.0 - frame.horizon
    tried = [(share * frame.height - frame.horizon) / depth for share in UNKNOWN_HORIZONS]
    return Warp(assumed=0.0 if known else min(tried, key=abs))


def _source(columns: FloatMap, rows: FloatMap, view: RoadView, warp: Warp) -> tuple[FloatMap, FloatMap]:
    """Returns where in the frame a pixel of the warped image comes from: the changes undone, last one first."""
    center = (view.width - 1) / 2.0
    x = 2.0 * center - columns if warp.flipped else columns
    u = rows - view.horizon
    share = np.where(u > 0.0, u / view.depth, 0.0)
    # k / u, which fades to zero where the curvature is no longer applied.
    curved = warp.curvature * view.depth * share / np.maximum(share, _CURVED_FROM) ** 2
    x = x - curved - warp.side * np.maximum(u, 0.0) - warp.pan * view.width
    return center + (x - center) / warp.zoom, view.horizon + u / warp.zoom


def _warped(lane: FloatArray, view: RoadView, warp: Warp) -> FloatArray:
    """Returns a polyline (N, 2) of the frame in the warped image, without points too close to the horizon."""
    center = (view.width - 1) / 2.0
    u = (lane[:, 1] - view.horizon) * warp.zoom
    x = center + (lane[:, 0] - center) * warp.zoom + warp.pan * view.width + warp.side * u
    share = u / view.depth
    x = x + warp.curvature * view.depth / np.maximum(share, _CURVED_FROM)
    x = 2.0 * center - x if warp.flipped else x
    return np.stack([x, view.horizon + u], axis=1)[share > 1.5 * _CURVED_FROM]


def _target(lanes: list[FloatArray], frame: RoadFrame, view: RoadView, assumed: RoadView) -> RegressionTarget:
    rows = view.horizon + np.asarray(SHARES) * view.depth
    center = (frame.width - 1) / 2.0
    usable = [(lane, kind) for lane, kind in zip(lanes, frame.kinds, strict=True) if len(lane) >= 3]
    sampled = [_at(lane, rows, view) for lane, _ in usable]
    columns = np.zeros((2, len(SHARES)), np.float32)
    known = np.zeros((2, len(SHARES)), np.float32)
    presence = np.full(2, 0.0 if frame.exhaustive else -1.0, np.float32)
    road_edge = np.full(2, -1.0, np.float32)
    for side, sign in ((0, -1.0), (1, 1.0)):
        candidates = [
            (sign * (x[0] - center), index) for index, (x, _) in enumerate(sampled) if sign * (x[0] - center) > 0.0
        ]
        if candidates:
            nearest = min(candidates)[1]
            x, weight = sampled[nearest]
            columns[side], known[side] = (x - center) / frame.width, weight
            presence[side] = 1.0
            kind = usable[nearest][1]
            road_edge[side] = -1.0 if kind is None else float(kind == "road_edge")
    horizon = (view.horizon - assumed.horizon) / assumed.depth if frame.has_road else np.nan
    return RegressionTarget(columns, known, presence, road_edge, horizon)


def _at(lane: FloatArray, rows: FloatArray, view: RoadView) -> tuple[FloatArray, FloatArray]:
    """Returns the columns of a polyline at `rows` and their weights: 1 within it, less where it is extrapolated."""
    u = lane[:, 1] - view.horizon
    below = rows - view.horizon
    # Near the camera a boundary is nearly straight, and a short label does not determine its curvature.
    basis = [np.ones_like(u), u, view.depth / u] if u.max() > 2.0 * u.min() else [np.ones_like(u), u]
    at_rows = [np.ones_like(below), below, view.depth / below][: len(basis)]
    coefficients = np.linalg.lstsq(np.stack(basis, axis=1), lane[:, 0], rcond=None)[0]
    extrapolated = np.stack(at_rows, axis=1) @ coefficients
    order = np.argsort(lane[:, 1], kind="stable")
    inside = (rows >= lane[:, 1].min() - 1.0) & (rows <= lane[:, 1].max() + 1.0)
    columns = np.where(inside, np.interp(rows, lane[order, 1], lane[order, 0]), extrapolated)
    nearer = rows > lane[:, 1].max()
    return columns, np.where(inside, 1.0, np.where(nearer, 0.3, 0.0))
