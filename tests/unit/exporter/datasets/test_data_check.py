"""The check of a data set, leaks between drives, splits by drive, and the contact sheet."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from labelfiles import Draw, check_dataset, clip_record, write_lines

from lanestream.errors import LabelError
from lanestream_exporter.datasets.contact_sheet import ContactSheet
from lanestream_exporter.datasets.reading import read_dataset
from lanestream_exporter.datasets.splits import refuse_leak, split_by_group


def test_a_frame_that_is_labeled_twice_is_reported(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    write_lines(tmp_path / "labels.jsonl", *[clip_record(image="a.jpg")] * 2)
    (fault,) = check_dataset(tmp_path).faults
    assert "labels.jsonl:2: a.jpg is labeled a second time, after" in str(fault)


def test_an_image_of_two_drives_is_reported(tmp_path: Path, draw: Draw) -> None:
    draw("monday/a.jpg")
    (tmp_path / "tuesday").mkdir()
    for name in ("tuesday/b.jpg", "monday/c.jpg"):
        shutil.copy(tmp_path / "monday/a.jpg", tmp_path / name)
    names = "monday/a.jpg", "tuesday/b.jpg", "monday/c.jpg"
    write_lines(tmp_path / "labels.jsonl", *(clip_record(image=name) for name in names))
    check = check_dataset(tmp_path)
    other, again = map(str, check.faults)
    assert "labels.jsonl:2: tuesday/b.jpg has the image of" in other
    assert "/tuesday', not " in other
    assert "labels.jsonl:3: monday/c.jpg has the same image as" in again
    assert check.contents.groups.total() == 3


def test_leaks_between_two_sides_are_reported(tmp_path: Path, draw: Draw) -> None:
    draw("train/monday/a.jpg")
    draw("val/tuesday/b.jpg")
    write_lines(tmp_path / "train" / "labels.jsonl", clip_record(image="monday/a.jpg", clip="road.mp4"))
    write_lines(tmp_path / "val" / "labels.jsonl", clip_record(image="tuesday/b.jpg", clip="street.mp4"))
    train = check_dataset(tmp_path / "train")
    assert train.leaks(check_dataset(tmp_path / "val")) == []
    write_lines(tmp_path / "val" / "labels.jsonl", clip_record(image="tuesday/b.jpg", clip="road.mp4"))
    (leak,) = train.leaks(check_dataset(tmp_path / "val"))
    assert "'road' is in both train and validation" in str(leak)
    shutil.copy(tmp_path / "train/monday/a.jpg", tmp_path / "val/tuesday/b.jpg")
    write_lines(tmp_path / "val" / "labels.jsonl", clip_record(image="tuesday/b.jpg", clip="street.mp4"))
    (leak,) = train.leaks(check_dataset(tmp_path / "val"))
    assert "labels.jsonl:1: its image is on the other side too" in str(leak)


def test_a_shared_group_is_refused() -> None:
    refuse_leak(["a", "b", "a"], ["c"], ["d"])
    with pytest.raises(LabelError, match="'b' is in both train and validation"):
        refuse_leak(["a", "b"], ["c", "b"])
    with pytest.raises(LabelError, match="'a' and 1 more is in both train and test"):
        refuse_leak(["a", "b"], ["c"], ["b", "a"])


def test_a_split_never_divides_a_group() -> None:
    groups = [f"drive {number % 9}" for number in range(200)] + ["long"] * 100
    for seed in range(20):
        split = split_by_group(groups, 0.2, seed)
        assert split.train | split.validation == set(groups)
        refuse_leak(split.train, split.validation)
        share = sum(group in split.validation for group in groups) / len(groups)
        assert 0.1 <= share <= 0.3
        assert split == split_by_group(sorted(groups), 0.2, seed)
    assert len({split_by_group(groups, 0.2, seed).validation for seed in range(20)}) > 1


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 1.0])
def test_each_side_of_a_split_has_a_group(share: float) -> None:
    split = split_by_group(["a"] * 90 + ["b"] * 10, share)
    assert split.train
    assert split.validation


def test_one_drive_cannot_be_split() -> None:
    with pytest.raises(LabelError, match="1 drive or clip can't be split"):
        split_by_group(["a"] * 50, 0.2)


def test_the_sheet_spreads_over_all_frames_and_shows_lanes(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    write_lines(tmp_path / "labels.jsonl", clip_record(image="a.jpg"))
    ((frame, image),) = read_dataset(tmp_path)
    dark = np.zeros_like(image)
    path = tmp_path / "out" / "sheet.png"
    sheet = ContactSheet(path)
    for _ in range(500):
        sheet.add(frame, dark)
    assert len(sheet) == 60
    sheet.write()
    drawn = cv2.imread(str(path))
    assert drawn is not None
    assert drawn.shape[1] == 6 * 320
    assert drawn[130, 90].max() > 100  # on the lane's second point
    assert drawn[40, 200].max() == 0
