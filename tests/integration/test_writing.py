"""Targets that can't be written, disks that get full, and names that are not text."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import av
import fakes
import numpy as np
import pytest

from lanestream import cli
from lanestream.errors import SourceError
from lanestream.local import LocalEngine
from lanestream.writing import check_file, check_folder
from lanestream_client.annotated_names import annotated_names
from lanestream_client.sinks import json_lines_sink, video_sink
from lanestream_exporter.training.run_files import write_checkpoint

# A name in Latin-1, as old cameras and archives have them.
NAME = os.fsdecode(b"stra\xdfe.jpg")


def lanestream(folder: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-m", "lanestream.cli", *arguments]
    environment = {**os.environ, **variables}
    done = subprocess.run(command, cwd=folder, capture_output=True, check=False, env=environment, timeout=120)
    assert b"Traceback" not in done.stderr, done.stderr.decode(errors="replace")
    return done


@pytest.fixture
def full_disk() -> Iterator[None]:
    """No file can get larger than 200 kB."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


@pytest.mark.parametrize(
    "command",
    [
        ["detect", "road.jpg", "--annotate"],
        ["detect", "road.jpg", "--jsonl"],
        ["stream", "road.jpg", "--video"],
        ["stream", "road.jpg", "--jsonl"],
        ["train", "classifier", "--run"],
        ["train", "regressor", "--run"],
        ["train", "checkpoint", "missing.pt"],
        ["export", "missing.pt"],
        ["data", "check", "missing", "--sheet"],
        ["evaluate", "--data", "missing", "--out"],
        ["evaluate", "--data", "missing", "--json"],
        ["evaluate", "tracking", "-o"],
    ],
)
def test_a_target_that_cannot_be_written_is_reported_before_the_work(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "road.jpg").write_bytes(fakes.image_file())
    (tmp_path / "file").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(LocalEngine, "load", lambda *_: LocalEngine(fakes.engine()))
    # Nothing can be written below a file, not even by root.
    monkeypatch.setattr(sys, "argv", ["lanestream", *command, "file/target.jpg"])
    with pytest.raises(SystemExit) as caught:
        cli.main()
    output, errors = capsys.readouterr()
    assert (caught.value.code, output) == (1, "")
    assert errors.splitlines()[-1].startswith("error: can't write file")


def test_a_folder_without_space_or_rights_is_reported(tmp_path: Path) -> None:
    for target in (Path("/proc/nothing"), Path("/sys/kernel/nothing")):
        with pytest.raises(SourceError, match=f"can't write {target}"):
            check_folder(target)
    with pytest.raises(SourceError, match="it is a folder"):
        check_file(tmp_path)
    check_file(Path("/dev/null"))
    check_file(tmp_path / "new" / "file.txt")
    assert list((tmp_path / "new").iterdir()) == []


@pytest.mark.usefixtures("full_disk")
def test_a_video_on_a_full_disk_can_be_played(tmp_path: Path) -> None:
    noise = np.random.default_rng(3)
    with (  # noqa: PT012 - the loop ends with the error
        pytest.raises(SourceError, match=r"can't write .*clip\.mp4: file too large"),
        video_sink(tmp_path / "clip.mp4", 10.0) as sink,
    ):
        for number in range(400):
            sink.write(noise.integers(0, 255, (64, 96, 3), np.uint8), number / 10.0)
    with av.open(str(tmp_path / "clip.mp4")) as container:
        seen = 0
        for _ in container.decode(video=0):
            seen += 1
            if seen == 10:
                break
    assert seen == 10


@pytest.mark.usefixtures("full_disk")
def test_lines_on_a_full_disk_are_kept(tmp_path: Path) -> None:
    from lanestream.protocol import ErrorMessage
    from lanestream_client.frames import SourceFrame, StreamResult

    written = 0
    with pytest.raises(SourceError, match="file too large"), json_lines_sink(tmp_path / "lines.jsonl") as sink:  # noqa: PT012
        while True:
            message = ErrorMessage(code="x", message=1000 * "y", seq=written)
            sink.write_result(StreamResult(SourceFrame(written, None), error=message))
            written += 1
    lines = (tmp_path / "lines.jsonl").read_text().split("\n")
    assert [json.loads(line)["seq"] for line in lines[:written]] == list(range(written))
    assert written > 100


@pytest.mark.usefixtures("full_disk")
def test_a_checkpoint_on_a_full_disk_leaves_the_one_before(tmp_path: Path) -> None:
    import torch

    path = tmp_path / "last.pt"
    write_checkpoint(path, {"network": torch.zeros(10)})
    before = path.read_bytes()
    with pytest.raises(SourceError, match=r"can't write .*last\.pt: file too large"):
        write_checkpoint(path, {"network": torch.zeros(1_000_000)})
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["last.pt"]


def test_names_that_are_not_utf_8_are_read_written_and_shown(tmp_path: Path) -> None:
    encoding = "ascii"
    (tmp_path / NAME).write_bytes(fakes.image_file())
    (tmp_path / "日本.jpg").write_bytes(fakes.image_file())
    arguments = "detect", NAME, "日本.jpg", "--annotate", "drawn", "--jsonl", "lines.jsonl"
    done = lanestream(tmp_path, *arguments, PYTHONIOENCODING=encoding)
    assert done.returncode == 0, done.stderr
    lines = (tmp_path / "lines.jsonl").read_text().splitlines()
    assert [json.loads(line)["file"] for line in lines] == [NAME, "日本.jpg"]
    assert sorted(path.name for path in (tmp_path / "drawn").iterdir()) == sorted(
        [f"{NAME}.lanes.jpg", "日本.jpg.lanes.jpg"]
    )
    done = lanestream(tmp_path, "detect", ".", NAME, "missing-\udcff.jpg", PYTHONIOENCODING=encoding)
    assert done.returncode == 1
    assert done.stdout.count(b"ego") == 4
    video = os.fsdecode(b"vid\xe9o.mp4")
    done = lanestream(
        tmp_path, "stream", NAME, "--video", video, "--jsonl", os.fsdecode(b"\xe9"), PYTHONIOENCODING=encoding
    )
    assert (done.returncode, (tmp_path / video).stat().st_size > 100) == (0, True), done.stderr


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["/d/a.jpg", "/d/b.jpg"], ["a.jpg", "b.jpg"]),
        (["/d/a.jpg", "/e/a.jpg"], ["d-a.jpg", "e-a.jpg"]),
        (["/x/d/a.jpg", "/y/d/a.jpg"], ["d-a.jpg", "y-d-a.jpg"]),
        (["/d/a.jpg", "/d/a.jpg"], ["d-a.jpg", "a.jpg.2"]),
        (["/d/a.jpg", "/d/a.jpg", "/d/a.jpg"], ["d-a.jpg", "a.jpg.2", "a.jpg.3"]),
        (["/d/a.jpg", "/e/A.JPG"], ["d-a.jpg", "e-A.JPG"]),
        (["/d/\u00e9.jpg", "/e/e\u0301.jpg"], ["d-\u00e9.jpg", "e-e\u0301.jpg"]),
        (["/d/a.jpg", "/e/a.jpg", "/f/d-a.jpg"], ["d-a.jpg", "e-a.jpg", "f-d-a.jpg"]),
    ],
)
def test_annotated_images_of_one_name_do_not_overwrite_each_other(files: list[str], names: list[str]) -> None:
    assert annotated_names([Path(file) for file in files]) == [f"{name}.lanes.jpg" for name in names]


def test_long_names_are_shortened() -> None:
    for name in (251 * "x" + ".jpg", 83 * "日" + ".jpg", NAME * 27):
        (short,) = annotated_names([Path("/d") / name])
        assert len(os.fsencode(short)) <= 255
        assert short.endswith(".jpg.lanes.jpg")
        if "日" in name:
            short.encode()


def test_two_images_of_one_name_are_both_annotated(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "1.jpg").write_bytes(fakes.image_file())
    assert lanestream(tmp_path, "detect", "a", "b/1.jpg", "--annotate", "drawn").returncode == 0
    assert sorted(path.name for path in (tmp_path / "drawn").iterdir()) == ["a-1.jpg.lanes.jpg", "b-1.jpg.lanes.jpg"]
