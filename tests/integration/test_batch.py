"""`lanestream batch`: its results, what it does with bad files and dying workers, and how it continues."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import click
import fakes
import pyarrow.parquet
import pytest
from batches import Batch, BrokenEngines, FatalEngines, full_disk, rows, run, write_clip

from lanestream.errors import BatchError, SourceError, WorkerLostError, WriteError
from lanestream_client.batch import pool
from lanestream_client.batch.state import open_state


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """A folder with two videos and three images."""
    folder = tmp_path / "archive"
    (folder / "stills").mkdir(parents=True)
    write_clip(folder / "one.mp4", 3)
    write_clip(folder / "two.mkv", 5)
    for number in range(3):
        (folder / "stills" / f"{number}.jpg").write_bytes(fakes.image_file())
    return folder


def summary(out: Path) -> dict[str, dict[str, object]]:
    content = json.loads((out / "summary.json").read_text())
    assert isinstance(content, dict)
    return content


def test_videos_and_images_of_an_archive(archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (archive / "notes.txt").touch()
    (archive / ".hidden.mp4").touch()
    out = archive / "out"
    assert run(archive, "--out", out) == 0
    output, errors = capsys.readouterr()
    found = rows(out)
    assert len(found) == 3 + 5 + 3
    assert [found[str(archive / "two.mkv"), seq]["timestamp"] for seq in range(5)] == [0.0, 0.04, 0.08, 0.12, 0.16]
    # A video is tracked, and an image is not: its boundaries have no history.
    assert found[str(archive / "two.mkv"), 4]["lanes"][0]["age_s"] > 0.1
    assert all(found[str(archive / "stills" / f"{number}.jpg"), 0]["lanes"] for number in range(3))
    assert "files                                   5" in output
    assert errors == "skipped everything but videos and images (.txt: 1)\n"
    assert summary(out)["this_run"] | {"seconds": 0, "frames_per_s": 0} == {
        "files": 5,
        "failed_files": 0,
        "frames": 11,
        "damaged_frames": 0,
        "hours_of_video": round(8 / 25 / 3600, 4),
        "boundaries": 22,
        "share_with_both_ego_boundaries": 1.0,
        "seconds": 0,
        "frames_per_s": 0,
    }
    assert sorted(path.name for path in out.iterdir()) == ["frames", "lock", "state.sqlite", "summary.json"]

    assert run(archive, "--out", out) == 0
    assert "5 of 5 files were processed before" in capsys.readouterr().err
    assert summary(out)["this_run"]["frames"] == 0
    assert summary(out)["all_runs"]["frames"] == 11
    assert rows(out) == found


def test_new_and_changed_files_are_processed(archive: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(archive, "--out", out) == 0
    write_clip(archive / "one.mp4", 7)
    write_clip(archive / "three.mp4", 2)
    (archive / "stills" / "1.jpg").write_bytes(fakes.image_file(width=640, height=360))
    (archive / "stills" / "3.jpg").write_bytes(fakes.image_file())
    assert run(archive, "--out", out) == 0
    found = rows(out)
    assert len(found) == 7 + 5 + 2 + 4
    assert found[str(archive / "stills" / "1.jpg"), 0]["width"] == 640
    # The video, the new one, and the images that were in one unit with the one that has changed.
    assert summary(out)["this_run"]["files"] == 2 + 4
    next((out / "frames").glob("two*")).unlink()
    assert run(archive, "--out", out) == 0
    assert rows(out) == found


def test_parquet_has_the_same_values_as_json(archive: Path, tmp_path: Path) -> None:
    camera = ("--camera-height", "1.4", "--field-of-view", "60")
    assert run(archive, "--out", tmp_path / "lines", *camera) == 0
    assert run(archive, "--out", tmp_path / "tables", "--format", "parquet", *camera) == 0
    expected = rows(tmp_path / "lines")
    frames = pyarrow.parquet.read_table(tmp_path / "tables" / "frames").to_pylist()
    lanes = pyarrow.parquet.read_table(tmp_path / "tables" / "lanes").to_pylist()
    assert len(frames) == len(expected) == 11
    for frame in frames:
        row = expected[frame["file"], frame["seq"]]
        assert frame["lanes"] == len(row["lanes"]) == 2
        assert all(frame[name] == row[name] for name in ("timestamp", "width", "height", "horizon", "events"))
        assert frame["clock"] == row.get("clock")
        assert {name: frame[f"ego_{name}"] for name in row["ego"]} == row["ego"]
        assert frame["departure_state"] == row["departure"]["state"]
    assert len(lanes) == 22
    for lane in lanes:
        row = expected[lane["file"], lane["seq"]]
        (wanted,) = (each for each in row["lanes"] if each["track_id"] == lane["track_id"])
        same = ("position", "state", "probability", "kind", "kind_probability", "age_s", "horizon")
        assert all(lane[name] == wanted[name] for name in same)
        assert [lane["v"], lane["b"], lane["k"]] == wanted["coefficients"]
        assert [lane["ground_a"], lane["ground_b"], lane["ground_c"]] == wanted["ground"]
        assert [list(point) for point in zip(lane["points_x"], lane["points_y"], strict=True)] == wanted["points"]
        assert [[lane["bottom_x"], lane["bottom_y"]], [lane["top_x"], lane["top_y"]]] == list(wanted["line"].values())
        assert lane["covariance"] == [value for line in wanted["covariance"] for value in line]
        assert lane["ground_covariance"] == [value for line in wanted["ground_covariance"] for value in line]
        assert (lane["marking_type"] or {}) == (wanted["marking"] or {})


def test_broken_files_are_reported_and_tried_again_on_request(
    archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    whole = (archive / "one.mp4").read_bytes()
    (archive / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    (archive / "empty.mp4").touch()
    (archive / "stills" / "bad.jpg").write_bytes(b"not a picture")
    (archive / "gone.mp4").symlink_to(archive / "missing.mp4")
    write_clip(archive / "black.mp4", 2, shade=0)
    assert run(archive, "--out", out, engines=FatalEngines()) == 1
    output = capsys.readouterr().out
    assert len(rows(out)) == 11
    failed = summary(out)["failed"]
    assert {Path(path).name: str(error).partition(" (")[0] for path, error in failed.items()} == {
        "cut.mp4": "the file has no index",
        "empty.mp4": "the file is empty",
        "bad.jpg": "not an image: it looks like text",
        "gone.mp4": "no such file or directory",
        "black.mp4": "RuntimeError: the detector failed",
    }
    assert all(f"failed: {path}: {error}\n" in output for path, error in failed.items())

    # Nothing to do, but the archive is still not complete.
    (archive / "stills" / "bad.jpg").write_bytes(fakes.image_file())
    assert run(archive, "--out", out) == 1
    assert (summary(out)["this_run"]["files"], summary(out)["all_runs"]["failed_files"]) == (1, 4)
    (archive / "gone.mp4").unlink()
    (archive / "cut.mp4").unlink()
    (archive / "empty.mp4").unlink()
    assert run(archive, "--out", out, "--retry-failed") == 0
    assert len(rows(out)) == 11 + 1 + 2


def test_what_is_wrong_with_files_that_can_be_used_is_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = tmp_path / "cut.jpg"
    image.write_bytes(fakes.image_file().removesuffix(b"\xff\xd9"))
    assert run(image, "--out", tmp_path / "out") == 0
    assert capsys.readouterr().err == (
        f"warning: {image}: the JPEG has no end marker; if it was cut short, its last pixels are missing\n"
    )


def test_what_was_seen_along_a_track(archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    write_clip(archive / "timed.mp4", 60, created="2024-05-01T14:00:00Z")
    (archive / "drives.gpx").write_text(
        "<gpx><trkpt lat='52' lon='13'><time>2024-05-01T12:00:01Z</time></trkpt>"
        "<trkpt lat='52' lon='13.1'><time>2024-05-01T12:00:11Z</time></trkpt></gpx>"
    )
    camera = ("--camera-height", "1.4", "--field-of-view", "60")
    assert run(archive, "--out", out, "--gpx", archive / "drives.gpx", "--gpx-offset", "-7200", *camera) == 0
    (path,) = (out / "geojson").iterdir()
    assert path.name.startswith("timed.mp4-")
    (feature,) = json.loads(path.read_text())["features"]
    assert feature["geometry"]["coordinates"] == [[13.0, 52.0], [13.01, 52.0], [13.0136, 52.0]]
    assert feature["properties"]["start"] == "2024-05-01T12:00:01.000Z"
    assert (feature["properties"]["file"], feature["properties"]["frames"]) == (str(archive / "timed.mp4"), 35)
    assert feature["properties"]["lane_width_m"] == pytest.approx(3.22, abs=0.1)
    assert {line.partition(" (")[0] for line in capsys.readouterr().err.splitlines()} == {
        "skipped everything but videos and images (.gpx: 1)".partition(" (")[0],
        f"warning: {archive / 'one.mp4'}: no positions: the video has no creation time",
        f"warning: {archive / 'two.mkv'}: no positions: the video has no creation time",
    }
    with pytest.raises(BatchError, match=r"gpx_offset was -7200\.0, is 0\.0"):
        run(archive, "--out", out, "--gpx", archive / "drives.gpx", *camera)
    with pytest.raises(click.UsageError, match="--gpx-offset needs --gpx"):
        run(archive, "--out", out, "--gpx-offset", "1")


def test_a_worker_that_dies_costs_only_the_file_that_it_was_working_on(
    archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    (archive / "stills" / "1.jpg").write_bytes(fakes.image_file(shade=255))
    write_clip(archive / "white.mp4", 2, shade=255)
    assert run(archive, "--out", out, engines=FatalEngines()) == 1
    assert {file for file, _ in rows(out)} == {
        str(archive / name) for name in ("one.mp4", "two.mkv", "stills/0.jpg", "stills/2.jpg")
    }
    error = "the worker process ended 2 times at this file, the last time by SIGKILL, perhaps for lack of memory"
    assert summary(out)["failed"] == {
        str(archive / "stills" / "1.jpg"): error,
        str(archive / "white.mp4"): error,
    }


def test_a_worker_that_hangs_is_ended(archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "_LONGEST_SILENCE_S", 0.5)
    os.mkfifo(archive / "pipe.mp4")  # nothing is ever written to it
    assert run(archive, "--out", tmp_path / "out") == 1
    assert summary(tmp_path / "out")["failed"] == {
        str(archive / "pipe.mp4"): "the worker process ended 2 times at this file, the last time killed after 0.5 s"
        " without progress"
    }
    assert len(rows(tmp_path / "out")) == 11


def test_an_engine_that_ends_its_process_ends_the_batch(archive: Path, tmp_path: Path) -> None:
    with pytest.raises(WorkerLostError, match="ended while it loaded the engine, with status 7"):
        run(archive, "--out", tmp_path / "out", engines=BrokenEngines())


def test_one_batch_at_a_time_writes_to_a_folder(archive: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with open_state(out), pytest.raises(BatchError, match=f"another batch writes to {out}: process {os.getpid()} on "):
        run(archive, "--out", out)
    assert run(archive, "--out", out) == 0  # the file of the lock is still there


def test_other_settings_are_refused(archive: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(archive, "--out", out) == 0
    expected = f'{out} has results of other settings: horizon was null, is 0.4; kinds was null, is ["marking"]'
    with pytest.raises(BatchError) as caught:
        run(archive, "--out", out, "--horizon", "0.4", "--kinds", "marking")
    assert caught.value.message == expected
    with pytest.raises(BatchError, match='format was "jsonl", is "parquet"'):
        run(archive, "--out", out, "--format", "parquet")
    assert len(rows(out)) == 11


def test_what_is_wrong_with_the_sources_is_said_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("missing.mp4\n")
    for source, message in (
        ("missing.mp4", "no such file or folder: missing.mp4"),
        ("missing/*.mp4", r"nothing matches missing/\*.mp4"),
        (f"@{tmp_path}/none.txt", "can't read the list .*/none.txt: no such file"),
        (f"@{tmp_path}/list.txt", "no such file or folder: missing.mp4"),
        (tmp_path, "no videos or images in"),
    ):
        with pytest.raises(SourceError, match=message):
            run(source, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_full_disk_stops_the_batch_and_loses_nothing(archive: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_clip(archive / "long.mp4", 100)
    with full_disk(100_000), pytest.raises(WriteError, match=f"can't write {out}: file too large"):
        run(archive, "--out", out)
    assert not list(out.glob("*/.*"))
    assert run(archive, "--out", out) == 0
    assert summary(out)["all_runs"]["frames"] == 111


def test_a_target_that_cannot_be_written_is_reported(archive: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(WriteError, match=r"can't write .*file/out: not a directory"):
        run(archive, "--out", tmp_path / "file" / "out")


def test_names_that_are_not_utf_8(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"stra\xdfe")
    folder.mkdir()
    clip = write_clip(tmp_path / "clip.mp4").rename(folder / os.fsdecode(b"\xe9t\xe9.mp4"))
    for kind in ("jsonl", "parquet"):
        for _ in range(2):
            assert run(folder, "--out", tmp_path / kind, "--format", kind) == 0
    assert {file for file, _ in rows(tmp_path / "jsonl")} == {str(clip)}
    assert summary(tmp_path / "jsonl")["this_run"]["files"] == 0


def test_an_unknown_provider_is_reported_in_one_line(archive: Path, tmp_path: Path) -> None:
    code, _, errors = Batch(archive, "--out", tmp_path / "out", "--provider", "abacus").finish()
    assert code == 1
    assert errors.startswith("error: Invalid value for '--provider': 'abacus' is not one of auto, ")
    assert errors.count("\n") == 1


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with 80 tiny videos."""
    folder = tmp_path_factory.mktemp("clips")
    for number in range(80):
        if number < 4:
            write_clip(folder / f"{number}.mp4", 1 + number % 2)
        else:
            (folder / f"{number}.mp4").write_bytes((folder / f"{number % 4}.mp4").read_bytes())
    return folder


def test_a_batch_that_is_killed_again_and_again_misses_nothing(clips: Path, tmp_path: Path) -> None:
    whole = Batch(clips, "--out", tmp_path / "whole").finish()
    assert whole[0] == 0, whole
    out = tmp_path / "out"
    for done, more_s in ((0, 0.3), (1, 0.0), (20, 0.011), (40, 0.023), (60, 0.002)):
        killed = Batch(clips, "--out", out)
        killed.wait_for_files(out, done)
        time.sleep(more_s)
        killed.process.kill()  # its workers notice and end
        assert killed.finish()[0] == -signal.SIGKILL
    code, _, errors = Batch(clips, "--out", out).finish()
    assert code == 0
    assert "of 80 files were processed before" in errors
    found = rows(out)
    assert len(found) == 120
    assert found == rows(tmp_path / "whole")
    assert not list(out.glob("*/.*"))
    assert summary(out)["all_runs"] == summary(tmp_path / "whole")["all_runs"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_a_batch_and_the_next_start_continues(tmp_path: Path, number: int) -> None:
    out, folder = tmp_path / "out", tmp_path / "clips"
    folder.mkdir()
    for name in range(12):
        write_clip(folder / f"{name}.mp4", 20)
    stopped = Batch(folder, "--out", out)
    stopped.wait_for_files(out, 2)
    os.killpg(stopped.process.pid, number)
    code, _, errors = stopped.finish()
    assert (code, errors) == (128 + number, "stopped; the same command continues\n")
    before = int(str(summary(out)["this_run"]["files"]))
    assert 2 <= before < 12
    code, _, errors = Batch(folder, "--out", out).finish()
    assert (code, errors) == (0, f"{before} of 12 files were processed before\n")
    assert len(rows(out)) == 240
