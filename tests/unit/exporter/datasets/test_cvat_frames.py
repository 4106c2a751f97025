"""Where the images of CVAT's exports are: named or numbered frames, of tasks of a video and of tasks of images."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from labelfiles import HEIGHT, LEFT, RIGHT, WIDTH, Draw, cvat_image, faults, polyline, read, write_cvat

from lanestream_exporter.datasets.entries import LabelEntry
from lanestream_exporter.datasets.reading import read_entries

VIDEO_TASK = (
    "<task><name>monday</name><size>3</size><mode>interpolation</mode><start_frame>0</start_frame>"
    "<stop_frame>2</stop_frame><frame_filter></frame_filter>"
    f"<original_size><width>{WIDTH}</width><height>{HEIGHT}</height></original_size><source>drive.mp4</source></task>"
)
FRAMES = [cvat_image(f"frame_{index:06d}", polyline(LEFT)) for index in range(3)]
TRACK = f'<track id="3" label="lane">{polyline(RIGHT, frame=0)}{polyline(LEFT, frame=2)}</track>'


def image_task(name: str = "monday", size: int = 3, frames: str = "") -> str:
    return f"<task><name>{name}</name><size>{size}</size><mode>annotation</mode>{frames}</task>"


@pytest.mark.parametrize("suffix", [".PNG", ".png", ".jpg", ".JPG", ".JPEG", ".webp"])
@pytest.mark.parametrize("folder", ["images/", "", "images/train/"])
def test_frames_of_a_video_task_have_names_without_suffix(tmp_path: Path, draw: Draw, suffix: str, folder: str) -> None:
    for index in range(3):
        draw(f"{folder}frame_{index:06d}{suffix}")
    frames = [frame.replace("<image ", '<image subset="train" ') for frame in FRAMES]
    write_cvat(tmp_path / "annotations.xml", *frames, meta=VIDEO_TASK)
    read_frames = read(tmp_path)
    assert [frame.source for frame in read_frames] == [f"{folder}frame_{index:06d}{suffix}" for index in range(3)]
    assert {frame.group for frame in read_frames} == {"drive"}


@pytest.mark.parametrize("video", ["drive.mp4", "drive.MP4", "videos/drive.mp4", "clips/drive.mp4"])
def test_frames_of_a_video_task_are_read_from_its_video(tmp_path: Path, clip: Path, video: str) -> None:
    (tmp_path / video).parent.mkdir(exist_ok=True)
    shutil.copy(clip / "drive.mp4", tmp_path / video)
    write_cvat(tmp_path / "annotations.xml", *FRAMES, meta=VIDEO_TASK)
    entries = [entry for entry in read_entries(tmp_path) if isinstance(entry, LabelEntry)]
    assert [entry.index for entry in entries] == [0, 1, 2]
    assert {entry.video for entry in entries} == {tmp_path / video}
    assert [frame.source for frame in read(tmp_path)] == [f"{Path(video).name}#{index}" for index in range(3)]


def test_the_video_of_a_task_without_source_has_the_name_of_the_task(tmp_path: Path, clip: Path) -> None:
    shutil.copy(clip / "drive.mp4", tmp_path)
    meta = "<project><tasks><task><id>7</id><name>drive</name></task></tasks></project>"
    frames = [frame.replace("<image ", '<image task_id="7" ') for frame in FRAMES]
    write_cvat(tmp_path / "annotations.xml", *frames, meta=meta)
    assert [frame.source for frame in read(tmp_path)] == ["drive.mp4#0", "drive.mp4#1", "drive.mp4#2"]


def test_images_come_before_the_video_which_is_known_too(tmp_path: Path, clip: Path, draw: Draw) -> None:
    shutil.copy(clip / "drive.mp4", tmp_path)
    draw("images/frame_000001.PNG")
    write_cvat(tmp_path / "annotations.xml", *FRAMES, meta=VIDEO_TASK)
    entries = [entry for entry in read_entries(tmp_path) if isinstance(entry, LabelEntry)]
    assert [entry.source for entry in entries] == ["drive.mp4#0", "images/frame_000001.PNG", "drive.mp4#2"]
    assert [(entry.video, entry.index) for entry in entries] == [(tmp_path / "drive.mp4", index) for index in range(3)]


def test_without_images_and_video_the_error_names_both(tmp_path: Path) -> None:
    write_cvat(tmp_path / "annotations.xml", FRAMES[0], meta=VIDEO_TASK)
    (fault,) = faults(tmp_path)
    assert "image frame_000000: there is no file images/frame_000000.jpg, and no video drive.mp4" in fault
    write_cvat(tmp_path / "annotations.xml", TRACK, meta=VIDEO_TASK)
    (fault,) = faults(tmp_path)
    assert "annotations.xml: there is no file drive.mp4, nor images/frame_000000.jpg" in fault


@pytest.mark.parametrize("folder", ["images/", "", "images/train/"])
def test_tracks_of_an_image_task_count_its_images(tmp_path: Path, draw: Draw, folder: str) -> None:
    for name in ("left.JPG", "middle.png", "right.jpg"):
        draw(f"{folder}{name}")
    write_cvat(tmp_path / "annotations.xml", TRACK, meta=image_task())
    first, last = read(tmp_path)
    assert (first.source, last.source) == (f"{folder}left.JPG", f"{folder}right.jpg")
    assert first.lanes[0].points.tolist() == RIGHT
    assert first.group == "task monday"


def test_an_image_task_with_frame_names_starts_with_its_first_image(tmp_path: Path, draw: Draw) -> None:
    for number in (1, 2, 3):  # as ffmpeg counts
        draw(f"images/frame_{number:06d}.png")
    write_cvat(tmp_path / "annotations.xml", TRACK, meta=image_task())
    assert [frame.source for frame in read(tmp_path)] == ["images/frame_000001.png", "images/frame_000003.png"]


def test_a_step_of_an_image_task_skips_frame_numbers(tmp_path: Path, draw: Draw) -> None:
    draw("images/a.png")
    draw("images/b.png")
    frames = "<start_frame>0</start_frame><stop_frame>3</stop_frame><frame_filter>step=2</frame_filter>"
    write_cvat(tmp_path / "annotations.xml", TRACK, meta=image_task(size=2, frames=frames))
    assert [frame.source for frame in read(tmp_path)] == ["images/a.png", "images/b.png"]


@pytest.mark.parametrize(
    ("names", "size", "expected"),
    [
        ("ab", 3, "the task has 3 frames, but there are 2 images"),
        ([*map(str, range(8, 11))], 3, "numbered without leading zeros"),
        ("", 3, "there are no images next to it"),
        ("ab", 2, "frame 2: the task has no frame 2"),
    ],
)
def test_an_image_task_whose_images_are_not_certain_is_refused(
    tmp_path: Path, draw: Draw, names: list[str], size: int, expected: str
) -> None:
    for name in names:
        draw(f"images/{name}.png")
    write_cvat(tmp_path / "annotations.xml", TRACK, meta=image_task(size=size))
    assert any(expected in fault for fault in faults(tmp_path))
    assert len(faults(tmp_path)) == 1


def test_tracks_that_are_no_boundaries_are_reported(tmp_path: Path, clip: Path) -> None:
    shutil.copy(clip / "drive.mp4", tmp_path)
    car = '<track id="1" label="car"><box frame="0" xtl="1" ytl="1" xbr="9" ybr="9"/></track>'
    write_cvat(tmp_path / "annotations.xml", car, meta=VIDEO_TASK)
    (fault,) = faults(tmp_path)
    assert "none of the shapes in" in fault
    assert "is taken for a lane boundary: box 'car' (1)" in fault


def test_frames_of_a_video_that_nobody_labeled_are_left_out(tmp_path: Path, clip: Path) -> None:
    shutil.copy(clip / "drive.mp4", tmp_path)
    car = '<box label="car" xtl="1" ytl="1" xbr="9" ybr="9"/>'
    unlabeled = cvat_image("frame_000000"), cvat_image("frame_000001", car)
    write_cvat(tmp_path / "annotations.xml", *unlabeled, FRAMES[2], meta=VIDEO_TASK)
    assert [frame.source for frame in read(tmp_path)] == ["drive.mp4#2"]
    write_cvat(tmp_path / "annotations.xml", *unlabeled, meta=VIDEO_TASK)
    (fault,) = faults(tmp_path)
    assert "is taken for a lane boundary: box 'car' (1)" in fault
