"""Labels for the frames between two labelled ones of a clip."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lanestream.errors import SourceError
from lanestream_exporter.datasets.clips import read_clip_labels
from lanestream_exporter.datasets.label_propagation import Between, frames_between
from lanestream_exporter.datasets.labels import PARTIAL, WHOLE, LabelledFrame
from lanestream_exporter.samples.patches import columns_at
from lanestream_exporter.scenes import Drive, sample_clip, write_clip
from lanestream_exporter.training.config import Frames, PatchData
from lanestream_exporter.training.ownframes import own_frames

LAST = 12
EGO = (-1, 1)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered drive in which every frame is labelled."""
    folder = tmp_path_factory.mktemp("drive")
    drive = sample_clip(np.random.default_rng(3), 640, 360, LAST + 1, 20.0, Drive("highway", fair=True))
    write_clip(drive, folder / "drive.mp4", folder / "drive.jsonl")
    return folder


def ego(frame: LabelledFrame) -> LabelledFrame:
    return replace(frame, lanes=tuple(lane for lane in frame.lanes if lane.position in EGO))


def ends(clip: Path) -> tuple[dict[int, LabelledFrame], dict[int, LabelledFrame]]:
    """The ego lane's labels of the first and the last frame, and those of all frames."""
    labels = {index: ego(frame) for index, frame in read_clip_labels(clip / "drive.jsonl", WHOLE).items()}
    return {index: labels[index] for index in (0, LAST)}, labels


def followed(clip: Path, labelled: Mapping[int, LabelledFrame], stride: int = 4) -> list[LabelledFrame]:
    return [frame for frame, _ in Between(stride).frames(clip / "drive.mp4", labelled)]


def test_frames_between_two_labelled_ones_are_labelled_where_the_paint_is(clip: Path) -> None:
    known, truth = ends(clip)
    between = list(Between(stride=4).frames(clip / "drive.mp4", known))
    assert [frame.source for frame, _ in between] == ["drive.mp4#4", "drive.mp4#8"]
    for index, (frame, image) in zip((4, 8), between, strict=True):
        assert image.shape == (360, 640, 3)
        assert frame.coverage == WHOLE
        assert [lane.position for lane in frame.lanes] == [lane.position for lane in known[0].lanes]
        for lane, true in zip(frame.lanes, truth[index].lanes, strict=True):
            off = np.abs(lane.points[:, 0] - columns_at(true, lane.points[:, 1]))
            assert np.nanmean(off) < 3.0


def test_a_boundary_on_which_the_two_sides_differ_is_left_out(clip: Path) -> None:
    known, _ = ends(clip)
    left, right = known[LAST].lanes
    top = right.points[:, 1].min()
    # It still meets the others at the horizon.
    aside = replace(right, points=right.points - np.outer(0.4 * (right.points[:, 1] - top), [1.0, 0.0]))
    known[LAST] = replace(known[LAST], lanes=(left, aside))
    frames = followed(clip, known)
    assert [[lane.position for lane in frame.lanes] for frame in frames] == [[-1], [-1]]
    assert all(frame.coverage == PARTIAL for frame in frames)  # what lies to the right is not known


def test_a_boundary_that_only_one_side_names_is_unknown_between(clip: Path) -> None:
    known, _ = ends(clip)
    known[LAST] = replace(known[LAST], lanes=known[LAST].lanes[:1])
    assert [[lane.position for lane in frame.lanes] for frame in followed(clip, known)] == [[-1], [-1]]
    assert all(frame.coverage == PARTIAL for frame in followed(clip, known))
    nameless = {i: replace(f, lanes=tuple(replace(lane, lane_id=None) for lane in f.lanes)) for i, f in known.items()}
    assert followed(clip, nameless) == []


def test_a_name_that_two_boundaries_have_is_no_name(clip: Path) -> None:
    known, _ = ends(clip)
    left, right = known[0].lanes
    known[0] = replace(known[0], lanes=(left, replace(left, lane_id=right.lane_id), right))
    frames = followed(clip, known)
    assert [[lane.position for lane in frame.lanes] for frame in frames] == [[-1], [-1]]
    assert all(frame.coverage == PARTIAL for frame in frames)


def test_labelled_frames_too_far_apart_tell_nothing_of_those_between(clip: Path) -> None:
    known, truth = ends(clip)
    between = Between(stride=2, longest=5)
    assert list(between.frames(clip / "drive.mp4", known)) == []
    told = between.frames(clip / "drive.mp4", known | {4: truth[4], 8: truth[8]})
    assert [frame.source for frame, _ in told] == ["drive.mp4#2", "drive.mp4#6", "drive.mp4#10"]
    ((frame, image),) = between.frames(clip / "drive.mp4", known | {8: truth[8]})
    assert frame.source == "drive.mp4#10"
    *_, (last, same) = Between(stride=2).frames(clip / "drive.mp4", known)
    assert last.source == frame.source
    np.testing.assert_array_equal(image, same)


def test_a_video_that_ends_too_early_or_is_none_is_told(clip: Path) -> None:
    known, _ = ends(clip)
    known[LAST + 5] = known.pop(LAST)
    with pytest.raises(SourceError, match=r"there is no frame 13: drive\.mp4 has 13 frames"):
        followed(clip, known)
    with pytest.raises(SourceError, match="can't be read as a video"):
        list(Between().frames(clip / "no.mp4", known))


def test_videos_of_ones_own_are_trained_on_between_their_labels(clip: Path, tmp_path: Path) -> None:
    (tmp_path / "drive.mp4").write_bytes((clip / "drive.mp4").read_bytes())
    lines = (clip / "drive.jsonl").read_text().splitlines()
    (tmp_path / "drive.jsonl").write_text(f"{lines[0]}\n{lines[LAST]}\n")
    other = tmp_path / "other"
    other.mkdir()
    (other / "road.mp4").write_bytes((clip / "drive.mp4").read_bytes())
    (other / "road.jsonl").write_text(json.dumps({**json.loads(lines[3]), "clip": "road.mp4"}) + "\n")

    def learnt(between: int) -> tuple[int, int]:
        data = PatchData(
            train=(Frames(path=str(tmp_path / "drive.jsonl")),),
            validation=(Frames(path=str(other / "road.jsonl")),),
            between=between,
        )
        train, check = own_frames(data)
        return len(list(train)), len(list(check))

    assert len(list(frames_between(tmp_path / "drive.jsonl", "clips", Between(stride=3)))) == 3
    assert learnt(between=3) == (5, 1)
    assert learnt(between=0) == (2, 1)
