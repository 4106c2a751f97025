"""Reading frames from files, folders and cameras, and the errors of sources that can't be read."""

from __future__ import annotations

import os
import struct
import threading
from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import fakes
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from lanestream.errors import CameraLostError, ImageError, SourceError
from lanestream.images.header import read_header
from lanestream_client import live_source
from lanestream_client.frames import SourceFrame
from lanestream_client.sinks import video_sink
from lanestream_client.sources import LiveReader, open_source


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


@pytest.mark.parametrize(
    "name", [b"vid\xe9o.mp4", b"12:30:01.mp4", b"pipe:0", b"drive 10% #2?.mp4", "日本.mp4".encode()]
)
def test_a_video_may_have_any_name(tmp_path: Path, name: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / os.fsdecode(name)
    Path(write_video(tmp_path / "a.mp4", [0.0, 0.04])).rename(path)
    monkeypatch.chdir(tmp_path)
    for spec in (path, path.name):
        with open_source(str(spec)) as source:
            assert len(list(source.frames)) == 2


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


class UnpluggedCapture:
    """A camera that delivers two frames each time it is opened, which fails the second time and after the fourth."""

    opened = 0

    def __init__(self, device: int | str) -> None:
        assert device == 4
        type(self).opened += 1
        self._frames = 2

    def isOpened(self) -> bool:  # noqa: N802
        return self.opened in {1, 3, 4}

    def get(self, _: int) -> float:
        return 0.0

    def read(self) -> tuple[bool, NDArray[np.uint8]]:
        self._frames -= 1
        return self._frames >= 0, np.zeros((48, 64, 3), np.uint8)

    def release(self) -> None:
        pass


def test_an_unplugged_camera_is_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", UnpluggedCapture)
    monkeypatch.setattr(live_source, "_FIRST_PAUSE_S", 0.01)
    notices: list[str] = []
    frames = []
    with open_source("4", reconnect_s=0.5, notify=notices.append) as source:
        assert source.live
        with pytest.raises(
            CameraLostError, match=r"camera 4 stopped delivering frames and did not come back within 0\.5"
        ):
            frames.extend(source.frames)
    assert [(frame.seq, frame.reconnects, frame.clock) for frame in frames] == [
        (seq, seq // 2, "arrival") for seq in range(6)
    ]
    assert source.counts.reconnects == 2
    assert [notice.split(";")[0].split(" after")[0] for notice in notices] == [
        "camera 4 stopped delivering frames",
        "camera 4 is back",
    ] * 2 + ["camera 4 stopped delivering frames"]


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
    images = [np.full((180, 320, 3), 6 * number, np.uint8) for number in range(40)]
    complete = write_mp4(tmp_path / "a.mp4", images, movflags="+faststart")
    (tmp_path / "cut.mp4").write_bytes(complete[: len(complete) * 2 // 3])
    with open_source(str(tmp_path / "cut.mp4")) as source:
        assert 0 < len(list(source.frames)) < 40


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

    with LiveReader(camera()) as newest:
        assert next(newest).seq == 0
        proceed[0].set()
        assert delivered.wait(fakes.WAIT_S)
        assert next(newest).seq == 3
        assert newest.skipped == 2
        proceed[1].set()
        with pytest.raises(SourceError, match="cable"):
            next(newest)


def test_a_live_source_can_be_read_without_skipping() -> None:
    frames = [SourceFrame(seq, 0.0) for seq in range(50)]
    with LiveReader(iter(frames), skip=False) as reader:
        assert [frame.seq for frame in reader] == list(range(50))
    assert reader.skipped == 0


def test_iteration_ends_with_a_live_source() -> None:
    with LiveReader(iter([SourceFrame(0, 0.0)])) as newest:
        assert [frame.seq for frame in newest] == [0]


def damage(path: Path, size: int) -> str:
    """Overwrites the middle of a file with zeros."""
    data = bytearray(path.read_bytes())
    start = len(data) // 2
    data[start : start + size] = bytes(size)
    path.write_bytes(data)
    return str(path)


def noise_video(path: Path, codec: str, count: int = 50) -> Path:
    """Writes a video whose frames have many bytes and depend on each other."""
    scene = np.random.default_rng(3).integers(0, 255, (120, 160, 3), np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.codec_context.gop_size = 10
        for number in range(count):
            frame = av.VideoFrame.from_ndarray(np.roll(scene, 5 * number, 1), "bgr24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@pytest.mark.parametrize(
    ("name", "codec"), [("a.mp4", "libx264"), ("a.mp4", "mpeg4"), ("a.mov", "mjpeg"), ("a.avi", "mjpeg")]
)
def test_damaged_bytes_cost_their_frames_and_are_counted(tmp_path: Path, name: str, codec: str) -> None:
    path = noise_video(tmp_path / name, codec)
    with open_source(damage(path, path.stat().st_size // 10)) as source:
        frames = list(source.frames)
    assert 0 < source.counts.lost_frames <= 20
    assert len(frames) + source.counts.lost_frames == 50


@pytest.mark.parametrize("codec", ["libx264", "mjpeg"])
def test_an_intact_video_loses_nothing(tmp_path: Path, codec: str) -> None:
    with open_source(str(noise_video(tmp_path / "a.avi", codec))) as source:
        assert len(list(source.frames)) == 50
    assert source.counts.lost_frames == 0


def test_frames_say_which_clock_their_time_is_from(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(fakes.image_file(".png"))
    raw = noise_video(tmp_path / "a.mjpeg", "mjpeg", 5)
    for path, clock in (
        (write_video(tmp_path / "a.mp4", [0.0, 0.04]), "source"),
        (raw, "frame_rate"),
        (tmp_path / "a.png", "frame_rate"),
    ):
        with open_source(str(path)) as source:
            assert {frame.clock for frame in source.frames} == {clock}


# Of the 3 x 3 matrix in a file, the first four numbers by their usual names, and what OpenCV does to show the image so.
ORIENTATIONS = {
    (1, 0, 0, 1): lambda image: image,
    (-1, 0, 0, 1): lambda image: cv2.flip(image, 1),
    (1, 0, 0, -1): lambda image: cv2.flip(image, 0),
    (-1, 0, 0, -1): lambda image: cv2.rotate(image, cv2.ROTATE_180),
    (0, 1, -1, 0): lambda image: cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE),
    (0, -1, 1, 0): lambda image: cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE),
    (0, 1, 1, 0): cv2.transpose,
    (0, -1, -1, 0): lambda image: cv2.flip(cv2.transpose(image), -1),
}


def write_mp4(path: Path, images: list[NDArray[np.uint8]], **options: str) -> bytes:
    """Writes a video and returns its bytes."""
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream("mpeg4", rate=25)
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width = images[0].shape[:2]
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "bgr24")))
        container.mux(stream.encode(None))
    return path.read_bytes()


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_a_video_is_shown_as_its_orientation_says(tmp_path: Path, orientation: tuple[int, int, int, int]) -> None:
    image = np.zeros((48, 64, 3), np.uint8)
    image[:24, :16] = 255  # no two orientations look the same
    write_mp4(tmp_path / "a.mp4", [image])
    data = bytearray((tmp_path / "a.mp4").read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40
    assert data[matrix : matrix + 4] == struct.pack(">i", 1 << 16)
    a, b, c, d = (value << 16 for value in orientation)
    data[matrix : matrix + 20] = struct.pack(">5i", a, b, 0, c, d)
    (tmp_path / "a.mp4").write_bytes(data)
    with open_source(str(tmp_path / "a.mp4")) as source:
        (frame,) = source.frames
    assert frame.pixels is not None
    expected = ORIENTATIONS[orientation](image)
    assert frame.pixels.shape == expected.shape
    assert np.abs(frame.pixels.astype(int) - expected).mean() < 8


def test_a_turned_picture_in_a_video_of_jpegs_is_upright(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x112] = 6  # to be turned by 90 degrees
    Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    (tmp_path / "a.jpg").rename(tmp_path / "a.mjpeg")
    with open_source(str(tmp_path / "a.mjpeg")) as source:
        assert next(source.frames).image().shape == (64, 48, 3)


def test_a_file_without_an_index_is_explained(tmp_path: Path) -> None:
    images = [np.full((48, 64, 3), number, np.uint8) for number in range(20)]
    index_in_front = write_mp4(tmp_path / "front.mp4", images, movflags="+faststart")
    index_at_the_end = write_mp4(tmp_path / "late.mp4", images)
    files = {
        "no-index.mp4": (index_at_the_end[: len(index_at_the_end) // 2], r"has no index \(`moov`\)"),
        "cut-index.mp4": (index_in_front[: index_in_front.index(b"moov") + 100], r"index \(`moov`\) is cut off"),
        "cut-index-late.mp4": (
            index_at_the_end[: index_at_the_end.index(b"moov") + 100],
            r"index \(`moov`\) is cut off",
        ),
        "fragment.mp4": (
            struct.pack(">I4s", 16, b"styp") + bytes(8) + struct.pack(">I4s", 16, b"moof") + bytes(8),
            "fragment",
        ),
        "empty.mp4": (b"", "the file is empty"),
        "zeros.mp4": (bytes(5000), "begins with zeros"),
    }
    for name, (data, message) in files.items():
        (tmp_path / name).write_bytes(data)
        with (
            pytest.raises(SourceError, match=rf"can't open .*{name}: .*{message}") as caught,
            open_source(str(tmp_path / name)),
        ):
            pass
        assert "\n" not in str(caught.value)


def test_a_waiting_reader_of_a_live_source_can_be_stopped() -> None:
    silence = threading.Event()

    def camera() -> Iterator[SourceFrame]:
        silence.wait(fakes.WAIT_S)
        yield SourceFrame(0, 0.0)

    with LiveReader(camera()) as newest:
        timer = threading.Timer(0.1, newest.stop)
        timer.start()
        assert list(newest) == []
        silence.set()
        timer.join()
