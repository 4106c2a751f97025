"""Results that are already there, as `lanestream stream --jsonl` writes them, against a clip's labels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from lanestream.errors import SourceError
from lanestream.protocol import LaneModel, LanesMessage
from lanestream.road.curve import Curve
from lanestream_exporter.datasets.clips import read_clip_labels
from lanestream_exporter.evaluation.boundaries import Found, Tally, count, ego_labels


def score(results: Path, labels: Path) -> dict[str, Any]:
    """Level B of the messages in `results` at the frames that `labels` name; a labelled frame without one misses all.

    Raises SourceError and LabelError that name the file and the line.
    """
    messages = {message.seq: message for message in _messages(results)}
    ego, every, both = Tally(), Tally(), 0
    for message in messages.values():
        both += message.ego.left is not None and message.ego.right is not None
    labelled = read_clip_labels(labels)
    for index, frame in labelled.items():
        found = [_found(lane) for lane in messages[index].lanes] if index in messages else []
        count(ego, [f for f in found if f.position in (-1, 1)], ego_labels(frame), frame)
        count(every, found, frame.lanes, frame)
    return {
        "frames": len(messages),
        "both_ego": round(both / max(len(messages), 1), 4),
        "labelled_frames": len(labelled),
        "ego": ego.summary(),
        "all": every.summary(),
    }


def _messages(path: Path) -> list[LanesMessage]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise SourceError(f"can't read {path}: {(error.strerror or str(error)).lower()}") from None
    except UnicodeDecodeError:
        raise SourceError(f"{path} is not a text file", "give what `--jsonl` wrote") from None
    messages = []
    for number, line in enumerate(lines, start=1):
        try:
            messages.append(LanesMessage.model_validate_json(line))
        except ValidationError:
            raise SourceError(f"{path}:{number} is no `lanes` message", "give what `--jsonl` wrote") from None
    return messages


def _found(lane: LaneModel) -> Found:
    return Found(Curve(lane.horizon, lane.coefficients), lane.line.top[1], lane.line.bottom[1], lane.position)
