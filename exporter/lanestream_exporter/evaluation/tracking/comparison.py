"""Puts the answers of a system beside the truth, frame by frame: all columns at the same rows, and who follows whom.

Rows are shares of the way from the true horizon (0) to the bottom row (1). Distances are in lane widths, so that they
mean the same at all rows: a lane of width W under a camera of height h is W / h pixels wide per row below the horizon.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from lanestream.road.curve import FloatArray
from lanestream_exporter.evaluation.tracking.answers import Answer, AnsweredLane
from lanestream_exporter.evaluation.tracking.truth import TruthFrame

SHARES: Final[FloatArray] = np.array([1.0, 0.8, 0.6, 0.45, 0.3, 0.2, 0.15])
# Indices of the rows of figures among `SHARES`.
BOTTOM, MIDDLE, FAR = 0, 2, 4
FIGURE_ROWS: Final = {"bottom": BOTTOM, "middle": MIDDLE, "far": FAR}
# Rows that stay where they are while the horizon moves: shares of the image height, as in the steadiness of clips.
STEADY_SHARES: Final[FloatArray] = np.array([0.7, 0.8, 0.9])
# An answer follows a true boundary if it is closer than this, in lane widths.
GATE: Final = 0.35
# The number of rows, the lowest ones at which the truth is inside the image, over which distances are averaged.
_COMPARED_ROWS: Final = 3
# If a scene has no ego lane: the usual lane over the height of the usual camera.
_USUAL_WIDTH, _USUAL_HEIGHT = 3.5, 1.4


@dataclass(frozen=True)
class FrameComparison:
    """One frame: L true and M reported boundaries at R rows.

    `true_x` (L, R) is NaN outside the image, `x` (M, R) and `sigma` (M, R) are the answer's, and `lane_px` (R,) is the
    width of a lane. `distances` (L, M) are in lane widths, NaN if a boundary has no row to compare. `pairs` are the
    answers (m) that follow true boundaries (l), one to one: truth index to answer index.
    `steady_x` (M, S) and `true_steady_x` (L, S) are columns at rows that are the same in all frames of the clip.
    """

    truth: TruthFrame
    answer: Answer
    rows: FloatArray
    lane_px: FloatArray
    true_x: FloatArray
    x: FloatArray
    sigma: FloatArray
    true_steady_x: FloatArray
    steady_x: FloatArray
    distances: FloatArray
    pairs: dict[int, int]

    def followed_by(self, lane_id: int) -> AnsweredLane | None:
        """Returns the answer that follows the true boundary `lane_id`; None if none does."""
        for truth_index, index in self.pairs.items():
            if self.truth.lanes[truth_index].lane_id == lane_id:
                return self.answer.lanes[index]
        return None

    def errors(self) -> FloatArray:
        """Returns the errors (P, R) of the pairs in pixels, NaN where the truth is outside or nothing is reported."""
        if not self.pairs:
            return np.empty((0, len(self.rows)))
        mine, theirs = list(self.pairs.values()), list(self.pairs)
        tops = np.array([self.answer.lanes[index].top for index in mine])
        errors: FloatArray = self.x[mine] - self.true_x[theirs]
        errors[self.rows[None] < tops[:, None] - 1.0] = np.nan
        return errors


@dataclass
class ClipRun:
    """A system's run over one clip: its kind, its seed or name, and all compared frames in the order of delivery.

    `steady_rows` (S,) are the rows that are the same in all frames: the bottom row, the far row and those of jitter.
    """

    kind: str
    name: str
    frames: list[FrameComparison] = field(default_factory=list)
    steady_rows: FloatArray = field(default_factory=lambda: np.empty(0))

    def add(self, truth: TruthFrame, answer: Answer) -> None:
        """Compares the next frame of the clip and adds it."""
        if not self.frames:
            far = truth.horizon + SHARES[FAR] * (truth.bottom - truth.horizon)
            self.steady_rows = np.array([truth.bottom, far, *(STEADY_SHARES * truth.height)])
        self.frames.append(compare(truth, answer, self.steady_rows))

    @property
    def seconds(self) -> float:
        """The time between the first and the last frame, by the number of frames and their median step."""
        return len(self.frames) * self.step

    @property
    def step(self) -> float:
        """The median time between two frames in seconds, of the steps that are positive."""
        times = np.array([frame.truth.timestamp for frame in self.frames])
        steps = np.diff(times)
        return float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0


def compare(truth: TruthFrame, answer: Answer, steady_rows: FloatArray) -> FrameComparison:
    """Returns the comparison of one frame; `steady_rows` (S,) are the same for all frames of a clip."""
    rows = truth.horizon + SHARES * (truth.bottom - truth.horizon)
    lane_px = _lane_px(truth, rows)
    true_x = _stack([lane.columns(rows) for lane in truth.lanes], len(rows))
    x = _stack([lane.curve.x(rows) for lane in answer.lanes], len(rows))
    distances = _distances(true_x, x, lane_px)
    slim = _without_points(truth)
    return FrameComparison(
        truth=slim,
        answer=answer,
        rows=rows,
        lane_px=lane_px,
        true_x=true_x,
        x=x,
        sigma=_stack([lane.sigma(rows) for lane in answer.lanes], len(rows)),
        true_steady_x=_stack([lane.columns(steady_rows) for lane in truth.lanes], len(steady_rows)),
        steady_x=_stack([lane.curve.x(steady_rows) for lane in answer.lanes], len(steady_rows)),
        distances=distances,
        pairs=_pairs(distances),
    )


def without_edges(truth: TruthFrame, answer: Answer) -> Answer:
    """Returns an answer without the reported edges of the road that are right, or that the truth says nothing about.

    They are those that follow a true edge, closer than any marking, and those beyond the outermost true marking. All
    others stay, as do reported markings, even on an edge.
    """
    if all(lane.kind == "marking" for lane in answer.lanes):
        return answer
    rows = truth.horizon + SHARES * (truth.bottom - truth.horizon)
    lane_px = _lane_px(truth, rows)
    x = _stack([lane.curve.x(rows) for lane in answer.lanes], len(rows))
    true_x = _stack([lane.columns(rows) for lane in truth.lanes], len(rows))
    edge_x = _stack([lane.columns(rows) for lane in truth.edges], len(rows))
    to_marking, to_edge = _nearest(_distances(true_x, x, lane_px)), _nearest(_distances(edge_x, x, lane_px))
    ignored = ((to_edge <= GATE) & (to_edge < to_marking)) | _beyond(true_x, x)
    kept = (lane for i, lane in enumerate(answer.lanes) if lane.kind == "marking" or not ignored[i])
    return replace(answer, lanes=tuple(kept))


def consecutive(run: ClipRun) -> Iterator[tuple[FrameComparison, FrameComparison]]:
    """Yields the pairs of neighboring frames of the same scene."""
    for before, after in zip(run.frames, run.frames[1:], strict=False):
        if before.truth.scene == after.truth.scene:
            yield before, after


def rate(count: float, total: float) -> float | None:
    """Returns `count` over `total`, rounded for reports; None if the total is 0."""
    return round(count / total, 5) if total else None


def rounded(value: float | None, digits: int = 4) -> float | None:
    """Returns `value` rounded for reports; None for None and NaN."""
    return None if value is None or not np.isfinite(value) else round(float(value), digits)


def _without_points(truth: TruthFrame) -> TruthFrame:
    """Returns the truth without the points of its boundaries, which long runs have no memory for."""
    lanes, edges = (
        tuple(replace(lane, points=np.empty((0, 2))) for lane in group) for group in (truth.lanes, truth.edges)
    )
    return replace(truth, lanes=lanes, edges=edges)


def _lane_px(truth: TruthFrame, rows: FloatArray) -> FloatArray:
    width, height = truth.ego.lane_width or _USUAL_WIDTH, truth.camera.get("height") or _USUAL_HEIGHT
    return np.asarray(width / height * np.maximum(rows - truth.horizon, 1.0))


def _stack(columns: Sequence[FloatArray], rows: int) -> FloatArray:
    return np.stack(columns) if columns else np.empty((0, rows))


def _distances(true_x: FloatArray, x: FloatArray, lane_px: FloatArray) -> FloatArray:
    """Returns the mean distances (L, M) in lane widths over the lowest rows at which each true boundary is visible."""
    distances = np.full((len(true_x), len(x)), np.nan)
    for index, columns in enumerate(true_x):
        visible: NDArray[np.intp] = np.flatnonzero(~np.isnan(columns))[:_COMPARED_ROWS]
        if len(visible):
            distances[index] = (np.abs(x[:, visible] - columns[visible]) / lane_px[visible]).mean(axis=1)
    return distances


def _nearest(distances: FloatArray) -> FloatArray:
    """Returns the least of the distances (L, M) of each of M boundaries; infinite if none is known."""
    return np.asarray(np.nan_to_num(distances, nan=np.inf).min(axis=0, initial=np.inf))


def _beyond(true_x: FloatArray, x: FloatArray) -> NDArray[np.bool_]:
    """Returns which of M boundaries lie outside all true ones over most of the lowest rows at which there is one."""
    visible = np.flatnonzero(~np.isnan(true_x).all(axis=0))[:_COMPARED_ROWS]
    if not len(visible):
        return np.ones(len(x), bool)
    left, right = np.nanmin(true_x[:, visible], axis=0), np.nanmax(true_x[:, visible], axis=0)
    return np.asarray(((x[:, visible] < left).mean(axis=1) > 0.5) | ((x[:, visible] > right).mean(axis=1) > 0.5))


def _pairs(distances: FloatArray) -> dict[int, int]:
    """Returns the one-to-one matching within the gate with the most pairs and, of those, the least total distance."""
    cost = np.where(distances <= GATE, distances, 1e3)  # NaN compares as False
    matched = zip(*linear_sum_assignment(cost), strict=True)
    return {int(i): int(j) for i, j in matched if cost[i, j] < 1e3}
