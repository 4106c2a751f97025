"""Measuring a model file on labelled frames, at two levels that are never mixed.

A: the classifier on the candidates that were proposed, and what was proposed at all. B: boundaries per frame, the ego
pair and all of them, from single images and, on clips, with the tracker.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import average_precision_score

from lanestream.detection import Prepared
from lanestream.engine import Engine
from lanestream.errors import SourceError
from lanestream.lanes import FrameResult, Image
from lanestream_exporter.datasets.clips import read_clip_labels
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.datasets.splits import LabelledClip, Split, labelled_clips, real_frames
from lanestream_exporter.evaluation.boundaries import Found, Tally, count, ego_labels
from lanestream_exporter.patches import FALSE, TRUE, UNKNOWN, TruthRule, distance_along


@dataclass
class CandidateTally:
    """Level A: probabilities and verdicts of all candidates, and which labels had a candidate."""

    probabilities: list[float] = field(default_factory=list)
    verdicts: list[int] = field(default_factory=list)
    ego_proposed: list[bool] = field(default_factory=list)
    all_proposed: list[bool] = field(default_factory=list)

    def summary(self, threshold: float) -> dict[str, Any]:
        """Precision, recall and accuracy over clearly true and false candidates, with counts; proposal recall."""
        verdicts, probability = np.array(self.verdicts), np.array(self.probabilities)
        clear = (verdicts == TRUE) | (verdicts == FALSE)
        truth, accepted = verdicts[clear] == TRUE, probability[clear] >= threshold
        right, wrong = int((accepted & truth).sum()), int((accepted & ~truth).sum())
        missed, refused = int((~accepted & truth).sum()), int((~accepted & ~truth).sum())
        return {
            "candidates": len(verdicts),
            "true": int(truth.sum()),
            "false": int((~truth).sum()),
            "unknown": int((verdicts == UNKNOWN).sum()),
            "unsure": int(len(verdicts) - clear.sum() - (verdicts == UNKNOWN).sum()),
            "confusion": {"tp": right, "fp": wrong, "fn": missed, "tn": refused},
            "precision": _ratio(right, right + wrong),
            "recall": _ratio(right, right + missed),
            "accuracy": _ratio(right + refused, len(truth)),
            "average_precision": round(float(average_precision_score(truth, probability[clear])), 4),
            "base_rate": _ratio(int(truth.sum()), len(truth)),
            "proposal_recall_ego": _ratio(sum(self.ego_proposed), len(self.ego_proposed)),
            "proposal_recall_all": _ratio(sum(self.all_proposed), len(self.all_proposed)),
            "labelled_ego": len(self.ego_proposed),
            "labelled_all": len(self.all_proposed),
        }


class Evaluation:
    """Measures an engine: its detector, its network, and the tracker of its sessions."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._detector = engine.detector
        self._rule = TruthRule()

    def images(self, root: Path, split: Split) -> dict[str, Any]:
        """Every labelled frame of `split` as a single image, a drive at a time: levels A and B."""
        tallies: dict[str, tuple[CandidateTally, Tally, Tally]] = {}
        for frame, image in real_frames(root, split):
            candidates, ego, every = tallies.setdefault(frame.group, (CandidateTally(), Tally(), Tally()))
            prepared = self._detector.prepare(image)
            outputs = self._engine.network.run(prepared.inputs)
            self._count_candidates(candidates, prepared, outputs, frame)
            session = self._engine.open_session()
            _count_boundaries(ego, every, session.conclude(prepared, outputs, 0.0), frame)
        return {
            group: {
                "candidates": candidates.summary(self._detector.threshold),
                "ego": ego.summary(),
                "all": every.summary(),
            }
            for group, (candidates, ego, every) in tallies.items()
        }

    def clips(self, root: Path, split: Split) -> dict[str, Any]:
        """The labelled clips of `split` frame after frame with the tracker: level B."""
        return {clip.name: self.clip(clip) for clip in labelled_clips(root, split)}

    def clip(self, clip: LabelledClip) -> dict[str, Any]:
        """One labelled clip with the tracker, every frame of it in order: level B at its labelled frames."""
        wanted = read_clip_labels(clip.labels)
        session = self._engine.open_session()
        ego, every, both, seen = Tally(), Tally(), 0, 0
        for index, image, timestamp in _decoded(clip.video, clip.frames):
            result = self._engine.process(session, image, timestamp)
            both += result.ego.left is not None and result.ego.right is not None
            seen += 1
            if index in wanted:
                _count_boundaries(ego, every, result, wanted[index])
        return {"frames": seen, "both_ego": _ratio(both, seen), "ego": ego.summary(), "all": every.summary()}

    def _count_candidates(
        self, tally: CandidateTally, prepared: Prepared, outputs: NDArray[np.float32], frame: LabelledFrame
    ) -> None:
        verdicts = self._rule.judge(prepared.candidates, frame, prepared.view)
        tally.verdicts += [int(v) for v in verdicts]
        tally.probabilities += [float(p) for p in outputs[:, 1]]
        ego = ego_labels(frame)
        for lane in frame.lanes:
            near = any(
                distance * 1280.0 / frame.width <= self._rule.near and overlap >= self._rule.overlap
                for distance, overlap in (distance_along(c, lane, prepared.view) for c in prepared.candidates)
            )
            tally.all_proposed.append(near)
            if any(lane is mine for mine in ego):
                tally.ego_proposed.append(near)


def _count_boundaries(ego: Tally, every: Tally, result: FrameResult, frame: LabelledFrame) -> None:
    found = [Found(lane.curve, lane.top, lane.bottom, lane.position) for lane in result.lanes]
    count(ego, [f for f in found if f.position in (-1, 1)], ego_labels(frame), frame)
    count(every, found, frame.lanes, frame)


def _decoded(video: Path, frames: range) -> Iterator[tuple[int, Image, float]]:
    """Frames of a clip with their index and their time in seconds."""
    capture = cv2.VideoCapture(str(video))
    if not capture.isOpened():
        raise SourceError(f"{video} can't be read as a video", "give the path of a video file")
    fps = capture.get(cv2.CAP_PROP_FPS) or 25.0
    capture.set(cv2.CAP_PROP_POS_FRAMES, frames.start)
    try:
        for index in frames:
            ok, image = capture.read()
            if not ok:
                return
            yield index, np.asarray(image, dtype=np.uint8), index / fps
    finally:
        capture.release()


def _ratio(part: int, whole: int) -> float | None:
    return round(part / whole, 4) if whole else None
