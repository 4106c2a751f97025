"""Scoring recorded results, as `lanestream stream --jsonl` writes them, against the labels of a clip."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from lanestream.errors import SourceError
from lanestream.protocol import LaneModel, LanesMessage
from lanestream.road.curve import Curve
from lanestream_exporter.datasets.clips import read_clip_labels
from lanestream_exporter.evaluation.boundaries import FrameMatches, ReportedBoundary, ego_labels, match


@dataclass
class BoundaryCounts:
    """Counts over frames, and the errors of all right boundaries in pixels at 640 wide."""

    right: int = 0
    wrong: int = 0
    missed: int = 0
    errors: list[float] = field(default_factory=list)

    def add(self, frame: FrameMatches) -> None:
        """Adds one frame."""
        self.right += len(frame.matches)
        self.wrong += frame.wrong
        self.missed += frame.missed
        self.errors += [boundary.error for boundary in frame.matches]

    @property
    def precision(self) -> float:
        """Returns the share of right ones among the reports; NaN without reports."""
        return self.right / (self.right + self.wrong) if self.right + self.wrong else float("nan")

    @property
    def recall(self) -> float:
        """Returns the share of found ones among the labels; NaN without labels."""
        return self.right / (self.right + self.missed) if self.right + self.missed else float("nan")

    @property
    def mean_error(self) -> float:
        """Returns the mean error of the right boundaries in pixels at 640 wide; NaN without right boundaries."""
        return float(np.mean(self.errors)) if self.errors else float("nan")

    def summary(self) -> dict[str, float | int | None]:
        """Returns all figures with their counts; a figure without data is None."""
        figures = {
            "precision": round(self.precision, 4),
            "recall": round(self.recall, 4),
            "mean_error_px_640": round(self.mean_error, 3),
        }
        counts = {"right": self.right, "wrong": self.wrong, "missed": self.missed}
        return {**counts, **{name: None if np.isnan(value) else value for name, value in figures.items()}}


def score_results(results: Path, labels: Path) -> dict[str, Any]:
    """Returns the level B figures of the messages in `results` at the frames labeled in `labels`.

    All labels of a frame without a message count as missed. Raises SourceError and LabelError, which name the file and
    the line.
    """
    messages = {message.seq: message for message in _read_messages(results)}
    both = sum(m.ego.left is not None and m.ego.right is not None for m in messages.values())
    ego, every = BoundaryCounts(), BoundaryCounts()
    labeled = read_clip_labels(labels)
    for index, frame in labeled.items():
        reports = [_report(lane) for lane in messages[index].lanes] if index in messages else []
        ego.add(match([report for report in reports if report.position in (-1, 1)], ego_labels(frame), frame))
        every.add(match(reports, frame.lanes, frame))
    return {
        "frames": len(messages),
        "both_ego": round(both / max(len(messages), 1), 4),
        "labeled_frames": len(labeled),
        "ego": ego.summary(),
        "all": every.summary(),
    }


def _read_messages(path: Path) -> list[LanesMessage]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise SourceError(f"can't read {path}: {(error.strerror or str(error)).lower()}") from None
    except UnicodeDecodeError:
        raise SourceError(f"{path} is not a text file", "give the output of `stream --jsonl`") from None
    messages = []
    for number, line in enumerate(lines, start=1):
        try:
            messages.append(LanesMessage.model_validate_json(line))
        except ValidationError:
            message = f"{path}:{number} is not a valid `lanes` message"
            raise SourceError(message, "give the output of `stream --jsonl`") from None
    return messages


def _report(lane: LaneModel) -> ReportedBoundary:
    curve = Curve(lane.horizon, lane.coefficients)
    return ReportedBoundary(curve, lane.line.top[1], lane.line.bottom[1], lane.position, kind=lane.kind)
