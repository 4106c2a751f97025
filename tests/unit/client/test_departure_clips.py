"""Clips around lane departures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import av
import fakes
import numpy as np
import pytest

from lanestream.errors import ImageError, SourceError
from lanestream.protocol import DepartureEventModel, error_message
from lanestream_client import departure_clips as module
from lanestream_client.departure_clips import departure_clips
from lanestream_client.frames import SourceFrame, StreamResult

FPS = 10.0


def result(seq: int, departs: bool = False) -> StreamResult:
    """Returns a frame's result at 10 frames per second, with a departure event if it `departs`."""
    time = seq / FPS
    event = DepartureEventModel(state="warning", side="right", track_id=1, timestamp=time)
    lanes = fakes.lanes(seq).model_copy(update={"timestamp": time, "events": [event] if departs else []})
    return StreamResult(SourceFrame(seq, time, pixels=np.full((48, 64, 3), 128, np.uint8)), lanes=lanes)


def record(folder: Path, departures: Sequence[int], frames: int = 100) -> list[Path]:
    with departure_clips(folder, 1.0, FPS) as clips:
        assert clips is not None
        for seq in range(frames):
            clips.write_result(result(seq, seq in departures))
    return clips.paths


def numbers(video: Path) -> list[int]:
    """Returns the frame numbers in a clip; its video has as many frames as its lines."""
    lines = [json.loads(line) for line in video.with_suffix(".jsonl").read_text().splitlines()]
    with av.open(str(video)) as container:
        assert len(list(container.decode(video=0))) == len(lines)
    return [line["seq"] for line in lines]


def test_a_clip_has_the_seconds_before_and_after_a_departure(tmp_path: Path) -> None:
    (path,) = record(tmp_path / "new", [40])
    assert path == tmp_path / "new" / "departure-000040-right.mp4"
    assert numbers(path) == list(range(30, 51))


def test_departures_close_together_share_a_clip(tmp_path: Path) -> None:
    first, second = record(tmp_path, [5, 12, 40])
    assert numbers(first) == list(range(23))
    assert numbers(second) == list(range(30, 51))


def test_a_clip_ends_with_the_stream(tmp_path: Path) -> None:
    (path,) = record(tmp_path, [98])
    assert numbers(path) == list(range(88, 100))


def test_a_folder_that_cannot_be_written_is_reported_before_any_departure(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(SourceError, match=r"can't write to the folder .*file/clips: not a directory"):
        record(blocked / "clips", [])


def test_failed_frames_are_recorded_with_their_error(tmp_path: Path) -> None:
    with departure_clips(tmp_path, 1.0, FPS) as clips:
        assert clips is not None
        failed = StreamResult(result(0).frame, error=error_message(ImageError("why"), seq=0))
        for each in (failed, result(1, departs=True)):
            clips.write_result(each)
    assert numbers(clips.paths[0]) == [0, 1]


def test_a_clip_begins_later_if_memory_is_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MOST_BYTES", 4 * len(result(0).frame.encoded()))
    (path,) = record(tmp_path, [40])
    assert numbers(path) == list(range(37, 51))


def test_times_that_jump_are_not_mixed(tmp_path: Path) -> None:
    with departure_clips(tmp_path, 1.0, FPS) as clips:
        assert clips is not None
        for each in (result(500), result(501), result(3), result(4, departs=True)):
            clips.write_result(each)
    assert numbers(clips.paths[0]) == [3, 4]


def test_nothing_is_recorded_without_a_departure_or_without_the_option(tmp_path: Path) -> None:
    assert record(tmp_path / "none", []) == []
    assert not (tmp_path / "none").exists()
    with departure_clips(tmp_path, None, FPS) as clips:
        assert clips is None


def test_an_unwritable_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SourceError, match="can't write"):
        record(tmp_path / "file", [5])
