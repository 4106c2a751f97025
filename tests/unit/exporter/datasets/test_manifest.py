"""The data set manifest: split rules, coverage, credits, clips, and one line for every mistake."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from labelfiles import LEFT, Draw, clip_record, labelme, line_strip, tusimple_record, write_lines, write_manifest

from lanestream.errors import LabelError, SettingsError
from lanestream_exporter.datasets import images
from lanestream_exporter.datasets.labels import Coverage
from lanestream_exporter.datasets.manifest import SHIPPED_MANIFEST, DatasetCollection, origin_of
from lanestream_exporter.datasets.splits import SPLITS
from lanestream_exporter.evaluation.measuring import EvaluationSet

BY_GROUP = {"by": "group", "val": 0.3}


def draw_drives(folder: Path, draw: Draw, *names: str, frames: int = 2) -> None:
    """Writes images with LabelMe labels, one folder per drive."""
    for name in names:
        for number in range(frames):
            draw(f"{name}/{number}.jpg")
            labelme(folder / name / f"{number}.json", f"{number}.jpg", line_strip(LEFT))


def sources(datasets: DatasetCollection) -> dict[str, list[str]]:
    return {split: [frame.source for frame, _ in datasets.frames(split)] for split in SPLITS}


def groups(datasets: DatasetCollection) -> dict[str, set[str]]:
    return {split: {frame.group for frame, _ in datasets.frames(split)} for split in SPLITS}


def opened(folder: Path, *specs: dict[str, Any]) -> DatasetCollection:
    return DatasetCollection.open(write_manifest(folder / "datasets.toml", *specs), folder)


def test_a_data_set_may_be_in_one_split(tmp_path: Path, draw: Draw) -> None:
    draw_drives(tmp_path, draw, "monday", "tuesday", "friday")
    datasets = opened(
        tmp_path,
        *({"name": day, "path": day, "split": split} for day, split in (("monday", "train"), ("tuesday", "val"))),
        {"name": "friday", "path": "friday/0.json", "split": "test"},
    )
    assert sources(datasets) == {"train": ["0.jpg", "1.jpg"], "val": ["0.jpg", "1.jpg"], "test": ["0.jpg"]}


def test_frames_are_split_by_drive(tmp_path: Path, draw: Draw) -> None:
    draw_drives(tmp_path / "roads", lambda name: draw(f"roads/{name}"), "one", "three", "seven")
    found = groups(opened(tmp_path, {"name": "roads", "path": "roads", "split": BY_GROUP}))
    assert (len(found["train"]), len(found["val"]), len(found["test"])) == (2, 1, 0)
    assert not found["train"] & found["val"]
    again = groups(opened(tmp_path, {"name": "roads", "path": "roads", "split": BY_GROUP}))
    assert again == found


def test_drives_are_found_without_decoding_images(tmp_path: Path, draw: Draw, monkeypatch: pytest.MonkeyPatch) -> None:
    draw_drives(tmp_path / "roads", lambda name: draw(f"roads/{name}"), "one", "three", "seven")
    decoded: list[object] = []
    decode = images.decode
    monkeypatch.setattr(images, "decode", lambda *arguments: decoded.append(None) or decode(*arguments))
    datasets = opened(tmp_path, {"name": "roads", "path": "roads", "split": BY_GROUP})
    datasets.require_splits("train", "val")
    assert not decoded
    assert sum(1 for split in SPLITS for _ in datasets.frames(split)) == len(decoded) == 6


def test_records_may_name_their_split(tmp_path: Path, draw: Draw) -> None:
    for name in "abc":
        draw(f"{name}.jpg")
    records = [tusimple_record(f"{name}.jpg") | {"split": split} for name, split in zip("abc", SPLITS, strict=True)]
    write_lines(tmp_path / "labels.json", *records)
    spec = {"name": "roads", "path": "labels.json", "split": {"by": "record"}}
    assert sources(opened(tmp_path, spec)) == {"train": ["a.jpg"], "val": ["b.jpg"], "test": ["c.jpg"]}
    write_lines(tmp_path / "labels.json", *records, tusimple_record("a.jpg"))
    with pytest.raises(LabelError, match=r"labels\.json:4: the record has no split .*another split rule"):
        sources(opened(tmp_path, spec))
    write_lines(tmp_path / "labels.json", records[0] | {"split": "dev"})
    with pytest.raises(LabelError, match=r"labels\.json:1: 'dev' is not a split"):
        sources(opened(tmp_path, spec))


def test_a_file_without_splits_is_split_by_the_manifest(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    write_lines(tmp_path / "labels.json", tusimple_record("a.jpg"))
    assert sources(opened(tmp_path, {"name": "a", "path": "labels.json", "split": "train"}))["train"] == ["a.jpg"]


def test_a_video_is_cut_by_frame_numbers(tmp_path: Path, clip: Path) -> None:
    shutil.copy(clip / "drive.mp4", tmp_path)
    shutil.copy(clip / "drive.jsonl", tmp_path)
    split = {"by": "frame", "train": [0, 1], "test": [2, 9]}
    datasets = opened(tmp_path, {"name": "drive", "path": "drive.jsonl", "split": split})
    assert sources(datasets) == {"train": ["drive.mp4#0"], "val": [], "test": ["drive.mp4#2"]}
    (test,) = datasets.clips("test")
    assert (test.name, test.video.name, test.frames, list(test.labeled)) == ("drive", "drive.mp4", range(2, 9), [2])
    (whole,) = opened(tmp_path, {"name": "drive", "path": "drive.jsonl", "split": "val"}).clips("val")
    assert list(whole.labeled) == [0, 1, 2]
    assert whole.frames.stop > 100_000
    with pytest.raises(LabelError, match="the manifest puts no frames into the split 'val'"):
        datasets.require_splits("train", "val")


def test_two_clips_of_one_name_cannot_be_evaluated(tmp_path: Path, clip: Path) -> None:
    for folder in ("a", "b"):
        shutil.copytree(clip, tmp_path / folder)
    datasets = opened(tmp_path, *({"name": folder, "path": folder, "split": "test"} for folder in ("a", "b")))
    with pytest.raises(LabelError, match="two clips are named 'drive'"):
        EvaluationSet.of_split(datasets, "test")


def test_stills_cannot_be_cut_by_frame_numbers(tmp_path: Path, draw: Draw) -> None:
    draw_drives(tmp_path, draw, "monday")
    spec = {"name": "monday", "path": "monday", "split": {"by": "frame", "train": [0, 5]}}
    with pytest.raises(LabelError, match=r"0\.json: 0\.jpg has no frame number"):
        sources(opened(tmp_path, spec))


def test_images_of_a_video_have_its_name_and_number(tmp_path: Path, draw: Draw, clip: Path) -> None:
    draw("a.jpg")
    write_lines(tmp_path / "labels.jsonl", clip_record(image="a.jpg", clip="drive.mp4", frame=2))
    spec = {"name": "drive", "path": "labels.jsonl", "split": "train"}
    assert sources(opened(tmp_path, spec))["train"] == ["drive.mp4#2"]
    assert list(opened(tmp_path, spec).clips("train")) == []
    shutil.copy(clip / "drive.mp4", tmp_path)
    (found,) = opened(tmp_path, spec).clips("train")
    assert list(found.labeled) == [2]


def test_coverage_comes_from_the_manifest(tmp_path: Path, draw: Draw) -> None:
    draw_drives(tmp_path, draw, "monday", "tuesday", "friday")
    datasets = opened(
        tmp_path,
        {"name": "a", "path": "monday", "split": "train"},
        {"name": "b", "path": "tuesday", "split": "train", "coverage": {"ego": True}},
        {"name": "c", "path": "friday", "split": "train", "coverage": {"ego": True, "open_sides": ["right"]}},
    )
    found = [frame.coverage for frame, _ in datasets.frames("train")][::2]
    assert found == [Coverage(), Coverage(ego=True), Coverage(ego=True, open_sides=(1,))]


def test_a_drive_in_two_splits_is_refused(tmp_path: Path, draw: Draw) -> None:
    draw_drives(tmp_path, draw, "monday")
    datasets = opened(
        tmp_path,
        {"name": "mine", "path": "monday", "split": "train"},
        {"name": "same", "path": "monday/0.json", "split": "val"},
    )
    with pytest.raises(LabelError, match=r"monday' is in train by 'mine' and in val by 'same'"):
        list(datasets.frames("train"))


def test_a_missing_data_set_is_reported_with_the_folder_that_paths_count_from(tmp_path: Path) -> None:
    datasets = opened(tmp_path, {"name": "roads", "path": "gone", "split": "train"})
    assert not datasets.any_present
    with pytest.raises(LabelError, match=r"the data set 'roads' is missing: .*gone .*--data or LANESTREAM_DATA"):
        list(datasets.frames("train"))


def test_a_missing_data_set_of_another_split_does_not_matter(tmp_path: Path, draw: Draw) -> None:
    draw_drives(tmp_path, draw, "monday")
    datasets = opened(
        tmp_path,
        {"name": "gone", "path": "gone", "split": "train"},
        {"name": "monday", "path": "monday", "split": "test"},
    )
    assert datasets.any_present
    assert [frame.source for frame, _ in datasets.frames("test")] == ["0.jpg", "1.jpg"]
    assert datasets.fingerprint()
    with pytest.raises(LabelError, match="'gone' is missing"):
        list(datasets.frames("train"))


def test_the_data_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = write_manifest(tmp_path / "datasets.toml", {"name": "a", "path": "a", "split": "train"})
    monkeypatch.setenv("LANESTREAM_DATA", "named")
    assert DatasetCollection.open(manifest, tmp_path / "given").root == tmp_path / "given"
    assert DatasetCollection.open(manifest).root == Path("named")
    monkeypatch.delenv("LANESTREAM_DATA")
    assert DatasetCollection.open(manifest).root == tmp_path
    assert DatasetCollection.open().root == Path("../shared/data")


def test_a_run_records_names_licenses_and_credits(tmp_path: Path) -> None:
    datasets = opened(
        tmp_path,
        {"name": "a", "path": "a", "split": "train", "license": "MIT", "credit": "A. Uthor"},
        {"name": "b", "path": "b", "split": BY_GROUP},
        {"name": "c", "path": "c", "split": "test"},
    )
    expected = [{"name": "a", "license": "MIT", "credit": "A. Uthor"}, {"name": "b"}]
    assert origin_of(datasets, 7) == {"real_frames": expected, "rendered_scenes": 7}
    assert origin_of(None, 0) == {"real_frames": [], "rendered_scenes": 0}


def test_the_fingerprint_changes_with_files_and_manifest(tmp_path: Path, draw: Draw) -> None:
    draw_drives(tmp_path, draw, "monday")
    spec: dict[str, Any] = {"name": "a", "path": "monday", "split": "train"}
    first = opened(tmp_path, spec).fingerprint()
    assert opened(tmp_path, spec).fingerprint() == first
    assert opened(tmp_path, spec | {"split": "val"}).fingerprint() != first
    record = json.loads((tmp_path / "monday" / "0.json").read_text())
    (tmp_path / "monday" / "0.json").write_text(json.dumps(record, indent=1))
    assert opened(tmp_path, spec).fingerprint() != first


def test_the_shipped_manifest_credits_every_data_set() -> None:
    datasets = DatasetCollection.open(SHIPPED_MANIFEST)
    assert len(datasets.manifest.dataset) == 8
    assert all({"name", "license", "credit"} == record.keys() for record in datasets.credits())


SOUND = 'name = "a"\npath = "a"\n'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "the key dataset is missing (accepted here: dataset)"),
        ("[[dataset]]\n", "the key dataset[0].name is missing (accepted here: name, path, format, split"),
        (f"[[dataset]]\n{SOUND}", "the key dataset[0].split is missing"),
        (
            f'[[dataset]]\n{SOUND}split = "train"\nlicence = "MIT"',
            "unknown key dataset[0].licence (accepted here: name",
        ),
        (f'[[dataset]]\n{SOUND}split = "all"', "'all' is not a split; accepted are train, val, test, or a table"),
        (f'[[dataset]]\n{SOUND}split = {{ by = "day" }}', "split = {'by': 'day'} is not accepted"),
        (f'[[dataset]]\n{SOUND}split = {{ by = "group", val = 1.5 }}', "dataset[0].split.val = 1.5 is not accepted"),
        (f'[[dataset]]\n{SOUND}split = {{ by = "frame" }}', "none of train, val and test has frames"),
        (
            f'[[dataset]]\n{SOUND}split = {{ by = "frame", train = [0, 9], val = [8, 9] }}',
            "the ranges of train, val and test overlap",
        ),
        (
            f'[[dataset]]\n{SOUND}split = "val"\nformat = "coco"',
            "unknown label format 'coco'; accepted are auto, tusimple",
        ),
        (
            f'[[dataset]]\n{SOUND}split = "val"\ncoverage = {{ open_sides = ["up"] }}',
            "open_sides[0] = 'up' is not accepted",
        ),
        (f'[[dataset]]\n{SOUND}split = "val"\n' * 2, "two data sets are named 'a'"),
        ("dataset", "is not a TOML file"),
    ],
)
def test_a_mistake_is_reported_in_one_line(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "datasets.toml"
    path.write_text(text)
    with pytest.raises(SettingsError) as raised:
        DatasetCollection.open(path)
    message = str(raised.value)
    assert message.startswith(str(path))
    assert expected in message
    assert "\n" not in message
    with pytest.raises(SettingsError, match=r"can't read .*gone\.toml"):
        DatasetCollection.open(tmp_path / "gone.toml")
