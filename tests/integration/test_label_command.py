"""The command `label` on rendered images and on a rendered video, and the commands of [data] without torch."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from lanestream.cli import main
from lanestream_exporter.datasets.reading import read_dataset
from lanestream_exporter.scenes import render_still, sample_clip, sample_scene, write_clip

# Runs each line of the standard input as a command line, without the packages that only [export] and [train] need.
WITHOUT_EXPORT = """
import sys
for name in ("torch", "onnx", "onnxscript", "sklearn", "motrics", "matplotlib", "jinja2"):
    sys.modules[name] = None
from lanestream.cli import main
for line in sys.stdin.read().splitlines():
    sys.argv = ["lanestream", *line.split()]
    try:
        main()
    except SystemExit as ended:
        print("exit code", ended.code)
"""

RunCommand = Callable[..., tuple[object, str, str]]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a folder with a rendered video, its labels, and a folder of images of which one is broken."""
    folder = tmp_path_factory.mktemp("drive")
    scene = sample_clip(np.random.default_rng(5), 640, 360, frames=12, fps=10.0)
    write_clip(scene, folder / "drive.mp4", folder / "drive.jsonl")
    images = folder / "images"
    images.mkdir()
    for number in range(3):
        still = render_still(sample_scene(np.random.default_rng(number), 640, 360))
        (images / f"{number}.jpg").write_bytes(cv2.imencode(".jpg", still.image)[1].tobytes())
    (images / "broken.jpg").write_bytes(b"\xff\xd8\xff")
    return folder


@pytest.fixture
def run(drive: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> RunCommand:
    """Returns a function that runs a command line in the folder of the drive, in this process."""
    monkeypatch.chdir(drive)

    def command(*arguments: object) -> tuple[object, str, str]:
        monkeypatch.setattr(sys, "argv", ["lanestream", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        captured = capsys.readouterr()
        return ended.value.code, captured.out, captured.err

    return command


def test_images_become_the_hardest_frames_first(run: RunCommand, tmp_path: Path) -> None:
    out = tmp_path / "out"
    code, output, errors = run("label", "images", out, "--format", "labelme", "--hardest", 2)
    assert (code, errors.count("\n")) == (0, 1)
    assert errors.startswith("skipped: images/broken.jpg: ")
    assert output.startswith(f"{out / 'images'}: 2 of 3 frames with ")
    frames = [frame for frame, _ in read_dataset(out)]
    assert [frame.source[:11] for frame in frames] == ["images/0001", "images/0002"]
    assert all(lane.kind for frame in frames for lane in frame.lanes)
    assert sorted(path.name for path in out.iterdir()) == ["difficulty.csv", "flags.yaml", "images", "labels.txt"]


def test_a_video_is_tracked_and_labeled_at_even_distances(run: RunCommand, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run("label", "drive.mp4", out, "--format", "cvat", "--every", 0.4)[0] == 0
    frames = {frame.source.split("_", 1)[1]: frame for frame, _ in read_dataset(out)}
    assert sorted(frames) == ["drive_000000.jpg", "drive_000004.jpg", "drive_000008.jpg"]
    ids = [{lane.lane_id for lane in frames[name].lanes} for name in sorted(frames)]
    assert ids[1] & ids[2] - {None}
    code, _, errors = run("label", "drive.mp4", out, "--format", "cvat")
    assert (code, errors.split(" (")[0]) == (1, f"error: {out} is not empty")


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        ("gone OUT", 1, "error: no such file or folder: gone"),
        ("drive.jsonl OUT", 1, "error: drive.jsonl can't be read as a video"),
        ("images/1.jpg drive.mp4 OUT", 1, "error: drive.mp4 is not an image, but one of several inputs"),
        ("images OUT --every 2", 2, "--every is for a video"),
        ("images/broken.jpg OUT", 1, "error: none of the images can be used"),
        ("images OUT --regressor none", 1, "error: hard frames are found by comparing the detectors candidates and"),
    ],
)
def test_unusable_input_is_reported(run: RunCommand, tmp_path: Path, arguments: str, code: int, expected: str) -> None:
    ended, _, errors = run("label", *arguments.replace("OUT", str(tmp_path / "out")).split(), "--format", "cvat")
    assert (ended, expected in errors) == (code, True)


def test_labels_are_mapped_by_an_option(run: RunCommand, tmp_path: Path) -> None:
    assert run("label", "images/0.jpg", tmp_path / "out", "--format", "labelme")[0] == 0
    (path,) = (tmp_path / "out" / "images").glob("*.json")
    path.write_text(path.read_text().replace('"label": "lane"', '"label": "paint"'))
    code, output, _ = run("data", "check", tmp_path / "out")
    assert (code, output.count("the label 'paint' of a line is not known")) == (1, 1)
    assert run("data", "check", tmp_path / "out", "--label", "paint=lane")[0] == 0
    code, _, errors = run("data", "check", tmp_path / "out", "--label", "paint=line")
    assert (code, errors) == (1, "error: 'paint=line' doesn't map a label (give LABEL=lane|road_edge|ignore)\n")


def test_the_commands_for_labels_need_no_torch(drive: Path, tmp_path: Path) -> None:
    lines = (
        f"label {drive}/images/0.jpg {tmp_path}/out --format label-studio",
        f"data check {drive} --format clips --sheet {tmp_path}/sheet.png",
        f"score {drive}/results.jsonl {drive}/drive.jsonl",
        f"data fetch tusimple --data {tmp_path}",
    )
    (drive / "results.jsonl").write_text("")
    command = [sys.executable, "-c", WITHOUT_EXPORT]
    ended = subprocess.run(command, input="\n".join(lines), capture_output=True, text=True, timeout=300, check=True)
    assert [line for line in ended.stdout.splitlines() if line.startswith("exit code")] == [
        *["exit code 0"] * 3,
        "exit code 1",
    ], ended.stderr
    for text in ("tasks.json: 1 frames", "frames: 12", '"labeled_frames": 12', "github.com/TuSimple"):
        assert text in ended.stdout
