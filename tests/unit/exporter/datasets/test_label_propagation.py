"""Label propagation: labels for the frames between two labeled frames of a clip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from labelfiles import write_manifest

from lanestream.errors import SourceError
from lanestream_exporter.datasets.clips import read_clip_labels
from lanestream_exporter.datasets.label_propagation import LabelPropagation
from lanestream_exporter.datasets.labels import PARTIAL, WHOLE, LabeledFrame
from lanestream_exporter.datasets.manifest import DatasetCollection
from lanestream_exporter.samples.truth import columns_at
from lanestream_exporter.scenes import Drive, sample_clip, write_clip

LAST = 12
EGO = (-1, 1)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the folder of a rendered drive in which every frame is labeled."""
    folder = tmp_path_factory.mktemp("drive")
    drive = sample_clip(np.random.default_rng(3), 640, 360, LAST + 1, 20.0, Drive("highway", fair=True))
    write_clip(drive, folder / "drive.mp4", folder / "drive.jsonl")
    return folder


def ego_only(frame: LabeledFrame) -> LabeledFrame:
    return replace(frame, lanes=tuple(lane for lane in frame.lanes if lane.position in EGO))


def key_frames(clip: Path) -> tuple[dict[int, LabeledFrame], dict[int, LabeledFrame]]:
    """Returns the ego lane's labels of the first and the last frame, and of all frames."""
    labels = {index: ego_only(frame) for index, frame in read_clip_labels(clip / "drive.jsonl", WHOLE).items()}
    return {index: labels[index] for index in (0, LAST)}, labels


def propagated(clip: Path, labeled: Mapping[int, LabeledFrame], stride: int = 4) -> list[LabeledFrame]:
    return [frame for frame, _ in LabelPropagation(stride).frames(clip / "drive.mp4", labeled)]


def test_edges_of_the_road_are_not_propagated(clip: Path) -> None:
    known, _ = key_frames(clip)
    edges = {
        index: replace(frame, lanes=(replace(frame.lanes[0], type="kerb"), *frame.lanes[1:]))
        for index, frame in known.items()
    }
    frames = propagated(clip, edges)
    assert [[lane.position for lane in frame.lanes] for frame in frames] == [[known[0].lanes[1].position]] * 2
    assert {frame.coverage for frame in frames} == {PARTIAL}


def test_propagated_labels_lie_on_the_paint(clip: Path) -> None:
    known, truth = key_frames(clip)
    frames = list(LabelPropagation(stride=4).frames(clip / "drive.mp4", known))
    assert [frame.source for frame, _ in frames] == ["drive.mp4#4", "drive.mp4#8"]
    for index, (frame, image) in zip((4, 8), frames, strict=True):
        assert image.shape == (360, 640, 3)
        assert frame.coverage == WHOLE
        assert [lane.position for lane in frame.lanes] == [lane.position for lane in known[0].lanes]
        for lane, true in zip(frame.lanes, truth[index].lanes, strict=True):
            off = np.abs(lane.points[:, 0] - columns_at(true, lane.points[:, 1]))
            assert np.nanmean(off) < 3.0


def test_a_boundary_on_which_the_two_passes_disagree_is_left_out(clip: Path) -> None:
    known, _ = key_frames(clip)
    left, right = known[LAST].lanes
    top = right.points[:, 1].min()
    # It still meets the others at the horizon.
    shifted = replace(right, points=right.points - np.outer(0.4 * (right.points[:, 1] - top), [1.0, 0.0]))
    known[LAST] = replace(known[LAST], lanes=(left, shifted))
    frames = propagated(clip, known)
    assert [[lane.position for lane in frame.lanes] for frame in frames] == [[-1], [-1]]
    assert all(frame.coverage == PARTIAL for frame in frames)  # what lies to the right is not known


def test_a_boundary_in_only_one_key_frame_is_unknown_in_between(clip: Path) -> None:
    known, _ = key_frames(clip)
    known[LAST] = replace(known[LAST], lanes=known[LAST].lanes[:1])
    assert [[lane.position for lane in frame.lanes] for frame in propagated(clip, known)] == [[-1], [-1]]
    assert all(frame.coverage == PARTIAL for frame in propagated(clip, known))
    without_ids = {
        i: replace(f, lanes=tuple(replace(lane, lane_id=None) for lane in f.lanes)) for i, f in known.items()
    }
    assert propagated(clip, without_ids) == []


def test_an_id_of_two_boundaries_is_not_used(clip: Path) -> None:
    known, _ = key_frames(clip)
    left, right = known[0].lanes
    known[0] = replace(known[0], lanes=(left, replace(left, lane_id=right.lane_id), right))
    frames = propagated(clip, known)
    assert [[lane.position for lane in frame.lanes] for frame in frames] == [[-1], [-1]]
    assert all(frame.coverage == PARTIAL for frame in frames)


def test_nothing_is_propagated_between_key_frames_too_far_apart(clip: Path) -> None:
    known, truth = key_frames(clip)
    propagation = LabelPropagation(stride=2, longest=5)
    assert list(propagation.frames(clip / "drive.mp4", known)) == []
    found = propagation.frames(clip / "drive.mp4", known | {4: truth[4], 8: truth[8]})
    assert [frame.source for frame, _ in found] == ["drive.mp4#2", "drive.mp4#6", "drive.mp4#10"]
    ((frame, image),) = propagation.frames(clip / "drive.mp4", known | {8: truth[8]})
    assert frame.source == "drive.mp4#10"
    *_, (last, same) = LabelPropagation(stride=2).frames(clip / "drive.mp4", known)
    assert last.source == frame.source
    np.testing.assert_array_equal(image, same)


def test_a_short_or_unreadable_video_is_reported(clip: Path) -> None:
    known, _ = key_frames(clip)
    known[LAST + 5] = known.pop(LAST)
    with pytest.raises(SourceError, match=r"there is no frame 13: drive\.mp4 has 13 frames"):
        propagated(clip, known)
    with pytest.raises(SourceError, match="can't be read as a video"):
        list(LabelPropagation().frames(clip / "no.mp4", known))


def test_videos_of_a_manifest_are_propagated_for_training_alone(clip: Path, tmp_path: Path) -> None:
    lines = (clip / "drive.jsonl").read_text().splitlines()
    for name, kept in (("drive", [lines[0], lines[LAST]]), ("road", [lines[3].replace("drive.mp4", "road.mp4")])):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}.mp4").write_bytes((clip / "drive.mp4").read_bytes())
        (tmp_path / name / f"{name}.jsonl").write_text("\n".join(kept) + "\n")
    manifest = write_manifest(
        tmp_path / "datasets.toml",
        {"name": "drive", "path": "drive", "split": "train"},
        {"name": "road", "path": "road/road.jsonl", "split": "val"},
    )
    datasets = DatasetCollection.open(manifest, tmp_path)
    sources = [frame.source for frame, _ in datasets.training_frames(LabelPropagation(stride=3))]
    assert sources == ["drive.mp4#0", "drive.mp4#12", "drive.mp4#3", "drive.mp4#6", "drive.mp4#9"]
    assert len(list(datasets.training_frames(None))) == 2
    assert [frame.source for frame, _ in datasets.frames("val")] == ["road.mp4#3"]
