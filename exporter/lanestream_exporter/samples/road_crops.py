"""Training samples of the regressor: the canonical picture of a frame, moved as other cameras and roads would show it.

On a flat road a boundary is x = v + b u + k / u with u = y - horizon. A camera that looks elsewhere changes v, one
further to a side changes b, a nearer zoom scales x and u, and a road of another bend changes k: each is a warp of the
picture, so one labelled frame tells of many.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.regression_detector import HORIZONS, RoadCropGeometry
from lanestream.road.curve import FloatArray
from lanestream.road.view import RoadView
from lanestream_exporter.samples.road_frames import RoadFrame

# The shares of the depth at which errors are counted.
SHARES: Final = (1.0, 0.8, 0.62, 0.48, 0.37, 0.28, 0.21, 0.16, 0.12)

# How strongly roads are bent, and how often so: motorways bend by a hundredth of the depth, mountain roads by a tenth.
_BENDS: Final = (0.012, 0.03, 0.08)
_BENT: Final = (0.6, 0.3, 0.1)

# Above this share of the depth a bend is not followed: it would tear the picture apart at the horizon.
_BENT_FROM: Final = 0.05


@dataclass(frozen=True)
class Target:
    """What the regressor should have said of a canvas.

    `columns` (2, S) of the left and the right boundary at `SHARES` of the depth under the true horizon, in image widths
    from the middle; `known` (2, S) is 1 where the label says so; `presence` (2,) is 1, 0, or -1 where nobody can tell;
    `horizon` in depths below where the canvas took it to be.
    """

    columns: NDArray[np.float32]
    known: NDArray[np.float32]
    presence: NDArray[np.float32]
    horizon: float


@dataclass(frozen=True)
class Warp:
    """A move of the camera or the road: `pan` in image widths, `side` in columns a row, `zoom`, `bend` in depths.

    `assumed` is how far the canvas takes the horizon to be from where it is, in depths; `flipped` mirrors all.
    """

    pan: float = 0.0
    side: float = 0.0
    zoom: float = 1.0
    bend: float = 0.0
    assumed: float = 0.0
    flipped: bool = False

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Warp:
        """A random one: mostly small, as cameras mostly look ahead from within their lane."""
        far_off = rng.random() < 0.2
        return cls(
            pan=rng.normal(0.0, 0.06),
            side=rng.normal(0.0, 0.15),
            zoom=float(np.exp(rng.normal(0.0, 0.12))),
            bend=rng.normal(0.0, rng.choice(_BENDS, p=_BENT)),
            assumed=rng.uniform(-0.25, 0.25) if far_off else rng.normal(0.0, 0.02),
            flipped=bool(rng.random() < 0.5),
        )


def sample(frame: RoadFrame, geometry: RoadCropGeometry, warp: Warp) -> tuple[NDArray[np.uint8], Target]:
    """The canvas (size, size, 3) in RGB of a frame under `warp`, and what is true of it."""
    view = RoadView(frame.width, frame.height, frame.horizon)
    seen = RoadView(frame.width, frame.height, frame.horizon + warp.assumed * view.depth)
    columns, rows = geometry.grid(seen)
    source_columns, source_rows = _source(columns, rows, view, warp)
    canvas = cv2.remap(
        frame.image(), source_columns.astype(np.float32), source_rows.astype(np.float32),
        cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    rgb = np.asarray(cv2.cvtColor(canvas, cv2.COLOR_BGR2RGB), dtype=np.uint8)
    return rgb, _target([_moved(lane, view, warp) for lane in frame.lanes], frame, view, seen)


def plain_warp(frame: RoadFrame, known: bool) -> Warp:
    """No move at all; the horizon where it is if `known`, else where an unknown frame's best look takes it to be."""
    depth = frame.height - 1.0 - frame.horizon
    looks = [(share * frame.height - frame.horizon) / depth for share in HORIZONS]
    return Warp(assumed=0.0 if known else min(looks, key=abs))


def _source(columns: FloatArray, rows: FloatArray, view: RoadView, warp: Warp) -> tuple[FloatArray, FloatArray]:
    """Where in the frame a pixel of the moved picture comes from: the moves undone, last first."""
    middle = (view.width - 1) / 2.0
    x = 2.0 * middle - columns if warp.flipped else columns
    u = rows - view.horizon
    bent = np.where(u > 0.0, u / view.depth, 0.0)
    # k / u, which falls back to nothing where the bend is no longer followed.
    gone = warp.bend * view.depth * bent / np.maximum(bent, _BENT_FROM) ** 2
    x = x - gone - warp.side * np.maximum(u, 0.0) - warp.pan * view.width
    return middle + (x - middle) / warp.zoom, view.horizon + u / warp.zoom


def _moved(lane: FloatArray, view: RoadView, warp: Warp) -> FloatArray:
    """A polyline (N, 2) of the frame in the moved picture, without what is too near to the horizon to be followed."""
    middle = (view.width - 1) / 2.0
    u = (lane[:, 1] - view.horizon) * warp.zoom
    x = middle + (lane[:, 0] - middle) * warp.zoom + warp.pan * view.width + warp.side * u
    share = u / view.depth
    x = x + warp.bend * view.depth / np.maximum(share, _BENT_FROM)
    x = 2.0 * middle - x if warp.flipped else x
    return np.stack([x, view.horizon + u], axis=1)[share > 1.5 * _BENT_FROM]


def _target(lanes: list[FloatArray], frame: RoadFrame, view: RoadView, seen: RoadView) -> Target:
    rows = view.horizon + np.asarray(SHARES) * view.depth
    middle = (frame.width - 1) / 2.0
    told = [_at(lane, rows, view) for lane in lanes if len(lane) >= 3]
    columns = np.zeros((2, len(SHARES)), np.float32)
    known = np.zeros((2, len(SHARES)), np.float32)
    presence = np.full(2, 0.0 if frame.exhaustive else -1.0, np.float32)
    for side, sign in ((0, -1.0), (1, 1.0)):
        beside = [(sign * (x[0] - middle), index) for index, (x, _) in enumerate(told) if sign * (x[0] - middle) > 0.0]
        if beside:
            x, weight = told[min(beside)[1]]
            columns[side], known[side] = (x - middle) / frame.width, weight
            presence[side] = 1.0
    return Target(columns, known, presence, (view.horizon - seen.horizon) / seen.depth)


def _at(lane: FloatArray, rows: FloatArray, view: RoadView) -> tuple[FloatArray, FloatArray]:
    """Columns of a polyline at `rows`, and how well they are known: 1 within it, less where it has to be continued."""
    u = lane[:, 1] - view.horizon
    below = rows - view.horizon
    # Near the camera a boundary is nearly straight; a short label does not tell its bend.
    basis = [np.ones_like(u), u, view.depth / u] if u.max() > 2.0 * u.min() else [np.ones_like(u), u]
    at_rows = [np.ones_like(below), below, view.depth / below][: len(basis)]
    coefficients = np.linalg.lstsq(np.stack(basis, axis=1), lane[:, 0], rcond=None)[0]
    continued = np.stack(at_rows, axis=1) @ coefficients
    order = np.argsort(lane[:, 1], kind="stable")
    inside = (rows >= lane[:, 1].min() - 1.0) & (rows <= lane[:, 1].max() + 1.0)
    columns = np.where(inside, np.interp(rows, lane[order, 1], lane[order, 0]), continued)
    nearer = rows > lane[:, 1].max()
    return columns, np.where(inside, 1.0, np.where(nearer, 0.3, 0.0))
