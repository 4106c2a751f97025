"""Writing results as videos and as JSON lines, and the report at the end of a run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import av
import fakes
import numpy as np
import pytest

from lanestream.errors import ImageError, LostError
from lanestream.protocol import EgoModel, TimingModel, error_message
from lanestream_client.frames import SourceFrame, StreamResult
from lanestream_client.requests import ServiceInfo
from lanestream_client.sinks import RunReport, json_lines_sink, nearest_rank, video_sink


def sizes_and_times(path: Path) -> list[tuple[int, int, float]]:
    with av.open(str(path)) as container:
        return [(frame.width, frame.height, round(frame.time, 3)) for frame in container.decode(video=0)]


def test_a_video_keeps_timestamps_and_has_one_size(tmp_path: Path) -> None:
    shapes = [(101, 181), (101, 181), (300, 200), (50, 400)]
    with video_sink(tmp_path / "new" / "a.mp4", 25.0) as sink:
        assert sink is not None
        for shape, time in zip(shapes, (5.0, 5.04, None, 5.04), strict=True):
            sink.write(np.full((*shape, 3), 128, np.uint8), time)
    assert sizes_and_times(tmp_path / "new" / "a.mp4") == [
        (182, 102, 0.0),
        (182, 102, 0.04),
        (182, 102, 0.08),
        (182, 102, 0.12),
    ]


def test_a_video_may_have_no_frames(tmp_path: Path) -> None:
    with video_sink(tmp_path / "a.mp4", 25.0):
        pass


def test_without_an_h264_encoder_the_video_is_mpeg4(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(av, "codecs_available", {"mpeg4"})
    with video_sink(tmp_path / "a.mp4", 25.0) as sink:
        assert sink is not None
        sink.write(np.full((48, 64, 3), 128, np.uint8), 0.0)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].codec_context.name == "mpeg4"


# Reads a pipe once it is full, so that its writer waits, and a Ctrl-C has interrupted the writer.
INTERRUPTING_READER = """
import os, select, signal, sys, time
path, writer = sys.argv[1], int(sys.argv[2])
with open(path, "rb", buffering=0) as pipe:
    other_writer = os.open(path, os.O_WRONLY)
    while select.select([], [other_writer], [], 0)[1]:
        time.sleep(0.01)
    time.sleep(0.1)
    os.kill(writer, signal.SIGINT)
    os.close(other_writer)
    while pipe.read(1 << 16):
        pass
"""


def test_an_interrupt_while_a_video_is_written_is_not_lost(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    os.mkfifo(path)
    noise = np.random.default_rng(0)
    # In another process: PyAV holds the lock of the interpreter while it closes a file.
    with subprocess.Popen([sys.executable, "-c", INTERRUPTING_READER, path, str(os.getpid())]) as reader:
        with pytest.raises(KeyboardInterrupt), video_sink(path, 1.0) as sink:  # noqa: PT012
            for number in range(200):
                sink.write(noise.integers(0, 255, (180, 320, 3), np.uint8), float(number))
        assert reader.wait(fakes.WAIT_S) == 0


def test_results_are_written_with_lanes_or_with_their_error(tmp_path: Path) -> None:
    image = fakes.image_file()
    error = error_message(ImageError("why"), seq=1)
    results = [
        StreamResult(SourceFrame(0, 0.0, data=image, name="a.jpg"), lanes=fakes.lanes(0)),
        StreamResult(SourceFrame(1, 0.04, data=image), error=error),
        StreamResult(SourceFrame(2, 0.08, data=b"not an image"), error=error),
    ]
    with video_sink(tmp_path / "a.mp4", 25.0) as video, json_lines_sink(tmp_path / "a.jsonl") as lines:
        assert video is not None
        assert lines is not None
        for result in results:
            video.write_result(result)
            lines.write_result(result)
    assert [time for _, _, time in sizes_and_times(tmp_path / "a.mp4")] == [0.0, 0.04]
    written = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    assert [(line.get("file"), line["type"]) for line in written] == [
        ("a.jpg", "lanes"),
        (None, "error"),
        (None, "error"),
    ]


def test_there_is_no_sink_without_a_path() -> None:
    with video_sink(None, 25.0) as video, json_lines_sink(None) as lines:
        assert video is None
        assert lines is None


def test_the_report_counts_and_measures() -> None:
    report = RunReport()
    for number in range(1, 101):
        timing = TimingModel(decode=1, propose=2, queue=0, infer=number, track=0.5, total=number + 3.5)
        ego = EgoModel(left=1, right=2 if number % 2 else None, offset=None)
        report.add_lanes(fakes.lanes(number).model_copy(update={"ego": ego, "timing_ms": timing}))
    report.add_failure()
    text = report.text(ServiceInfo("m 1", "cpu"), dropped=4)
    assert text.startswith("105 frames: 100 answered, 4 dropped, 1 failed; ")
    assert "both ego boundaries in 50.0 %" in text
    assert "infer       50.00    95.00" in text
    assert text.endswith("model m 1 on cpu")
    assert "ms" not in RunReport().text(ServiceInfo("m 1", "cpu")).split()


def test_the_report_distinguishes_lost_results_from_failed_frames() -> None:
    report = RunReport()
    frame = SourceFrame(0, None)
    for error in (LostError("m"), ImageError("m"), ImageError("m")):
        report.write_result(StreamResult(frame, error=error_message(error, seq=0)))
    assert report.text(ServiceInfo("m 1", "cpu")).startswith("3 frames: 0 answered, 0 dropped, 2 failed, 1 lost; ")


def test_percentiles_are_values_that_occurred() -> None:
    ordered = [1.0, 2.0, 3.0, 4.0]
    assert [nearest_rank(ordered, percent) for percent in (0, 25, 50, 95, 100)] == [1.0, 1.0, 2.0, 4.0, 4.0]
