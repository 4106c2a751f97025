"""Reading frames from files, folders and cameras, and the errors of sources that can't be read."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Self

import av
import fakes
import numpy as np
import pytest

from lanestream.errors import ImageError, SourceError
from lanestream.images.header import read_header
from lanestream_client.frames import SourceFrame
from lanestream_client.sinks import video_sink
from lanestream_client.sources import NewestFrames, open_source


def write_video(path: Path, times: list[float], size: tuple[int, int] = (64, 48)) -> str:
    with video_sink(path, 25.0) as sink:
        assert sink is not None
        for number, time in enumerate(times):
            sink.write(np.full((size[1], size[0], 3), 25 * (number % 10), np.uint8), time)
    return str(path)


def test_frames_of_a_video_have_its_timestamps(tmp_path: Path) -> None:
    times = [0.0, 0.04, 0.12, 0.2]
    with open_source(write_video(tmp_path / "a.mp4", times)) as source:
        frames = list(source.frames)
        assert (source.live, source.length) == (False, 4)
    assert [frame.seq for frame in frames] == [0, 1, 2, 3]
    assert [frame.timestamp for frame in frames] == pytest.approx(times, abs=1e-4)
    assert [round(float(frame.image().mean()) / 25) for frame in frames] == [0, 1, 2, 3]
    assert read_header(frames[0].encoded()).kind == "JPEG"


def test_a_folder_is_read_in_natural_order_and_its_files_are_not_reencoded(tmp_path: Path) -> None:
    for name in ("img10.JPG", "img9.png", "img9a.webp", "notes.txt"):
        (tmp_path / name).write_bytes(
            fakes.image_file(f".{name[-3:].lower().replace('ebp', 'webp')}") if name[0] == "i" else b""
        )
    with open_source(str(tmp_path), fps=10.0) as source:
        frames = list(source.frames)
        assert (source.length, source.fps) == (3, 10.0)
    assert [frame.name for frame in frames] == ["img9.png", "img9a.webp", "img10.JPG"]
    assert [frame.timestamp for frame in frames] == [0.0, 0.1, 0.2]
    assert frames[0].encoded() == (tmp_path / "img9.png").read_bytes()
    assert frames[2].image().shape == (180, 320, 3)


def test_one_image_is_a_source(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(fakes.image_file(".png"))
    with open_source(str(tmp_path / "a.png")) as source:
        assert [frame.name for frame in source.frames] == ["a.png"]


def test_an_invalid_source_is_reported(tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("text")
    (tmp_path / "empty").mkdir()
    for spec, message in (
        ("none.mp4", "no such file"),
        ("text.mp4", "can't open"),
        ("empty", "no images in the folder"),
    ):
        with pytest.raises(SourceError, match=message), open_source(str(tmp_path / spec)):
            pass


def test_a_missing_camera_is_reported() -> None:
    with pytest.raises(SourceError, match="camera 97 was not found"), open_source("97"):
        pass


def test_a_file_with_sound_only_is_refused(tmp_path: Path) -> None:
    path = str(tmp_path / "sound.wav")
    with av.open(path, "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
    with pytest.raises(SourceError, match="has no video stream"), open_source(path):
        pass


def test_a_truncated_video_is_read_up_to_its_end(tmp_path: Path) -> None:
    complete = Path(write_video(tmp_path / "a.mp4", [0.04 * number for number in range(40)], (320, 180)))
    (tmp_path / "cut.mp4").write_bytes(complete.read_bytes()[: complete.stat().st_size * 2 // 3])
    with open_source(str(tmp_path / "cut.mp4")) as source:
        assert 0 < len(list(source.frames)) < 40


def test_a_network_stream_that_fails_says_after_how_many_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_video(tmp_path / "a.mp4", [0.0, 0.04, 0.08])

    class FailingContainer:
        def __init__(self, container: av.container.InputContainer) -> None:
            self.streams, self.duration, self._container = container.streams, None, container

        def __enter__(self) -> Self:
            return self

        def __exit__(self, *_: object) -> None:
            self._container.close()

        def decode(self, video: int) -> Iterator[av.VideoFrame]:
            yield from self._container.decode(video=video)
            raise av.error.InvalidDataError(1, "broken data")

    open_container = av.open
    monkeypatch.setattr(av, "open", lambda _, **__: FailingContainer(open_container(path)))
    with open_source("rtsp://user:password@camera/1") as source:
        assert source.live
        assert [next(source.frames).seq for _ in range(3)] == [0, 1, 2]
        with pytest.raises(SourceError, match=r"^rtsp://camera/1 failed after 3 frames: broken data"):
            next(source.frames)


def test_a_frame_that_is_not_an_image_has_no_pixels() -> None:
    with pytest.raises(ImageError, match=r"a\.jpg can't be decoded"):
        SourceFrame(0, None, data=b"x", name="a.jpg").image()


def test_a_live_source_yields_its_newest_frame() -> None:
    proceed = [threading.Event(), threading.Event()]
    delivered = threading.Event()

    def camera() -> Iterator[SourceFrame]:
        yield SourceFrame(0, 0.0)
        assert proceed[0].wait(fakes.WAIT_S)
        for seq in (1, 2, 3):
            yield SourceFrame(seq, 0.0)
        delivered.set()
        assert proceed[1].wait(fakes.WAIT_S)
        raise SourceError("the cable is unplugged")

    with NewestFrames(camera()) as newest:
        assert next(newest).seq == 0
        proceed[0].set()
        assert delivered.wait(fakes.WAIT_S)
        assert next(newest).seq == 3
        assert newest.skipped == 2
        proceed[1].set()
        with pytest.raises(SourceError, match="cable"):
            next(newest)


def test_iteration_ends_with_a_live_source() -> None:
    with NewestFrames(iter([SourceFrame(0, 0.0)])) as newest:
        assert [frame.seq for frame in newest] == [0]
