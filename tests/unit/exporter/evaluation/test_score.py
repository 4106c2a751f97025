"""`lanestream score`: results of a stream against the labels of its clip."""

from __future__ import annotations

import json
from pathlib import Path

import fakes
import pytest

from lanestream.errors import SourceError
from lanestream_exporter.evaluation.score import score_results


@pytest.fixture
def labels(tmp_path: Path) -> Path:
    """Returns the labels of one frame with one boundary, which the fake answers do not report."""
    lanes = [{"position": -1, "points": [[100.0, 170.0], [125.0, 135.0], [150.0, 100.0]]}]
    path = tmp_path / "labels.jsonl"
    record = {"clip": "a.mp4", "frame": 0, "width": 320, "height": 180, "lanes": lanes}
    path.write_text(json.dumps(record) + "\n", encoding="utf-8")
    return path


def test_results_of_a_stream_have_more_fields_than_a_message(tmp_path: Path, labels: Path) -> None:
    results = tmp_path / "results.jsonl"
    answers = [{**fakes.lanes(seq).model_dump(mode="json"), "clock": "frame_rate", "file": "a.jpg"} for seq in (0, 1)]
    results.write_text("".join(json.dumps(answer) + "\n" for answer in answers), encoding="utf-8")
    figures = score_results(results, labels)
    assert (figures["frames"], figures["labeled_frames"]) == (2, 1)
    assert (figures["all"]["right"], figures["all"]["missed"]) == (0, 1)


def test_another_file_is_refused_with_its_line(tmp_path: Path, labels: Path) -> None:
    results = tmp_path / "results.jsonl"
    results.write_text(fakes.lanes(0).model_dump_json() + '\n{"lanes": 3}\n', encoding="utf-8")
    with pytest.raises(SourceError, match=r"results\.jsonl:2 is not a valid `lanes` message \(give the output of"):
        score_results(results, labels)
