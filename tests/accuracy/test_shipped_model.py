"""The shipped model on real frames that it was not trained on: the README's figures, with a margin for rounding."""

from __future__ import annotations

from pathlib import Path

import pytest

from lanestream.engine import SHIPPED_MODEL, Engine, load_engine
from lanestream_exporter.datasets.manifest import DatasetCollection
from lanestream_exporter.datasets.splits import SPLITS
from lanestream_exporter.evaluation.measuring import EvaluationSet, run_evaluation
from lanestream_exporter.evaluation.methods import ServedModel


@pytest.fixture(scope="module")
def engine() -> Engine:
    return load_engine(provider="cpu")


@pytest.fixture(scope="module")
def datasets(data: Path) -> DatasetCollection:
    return DatasetCollection.open(None, data)


def test_the_shipped_files_are_small() -> None:
    sizes = [path.stat().st_size for path in SHIPPED_MODEL.parent.glob("*.onnx")]
    assert sizes
    assert max(sizes) <= 25e6
    assert sum(sizes) <= 60e6


def test_the_easy_clip_is_tracked_exactly(engine: Engine, datasets: DatasetCollection) -> None:
    clips = [clip for clip in datasets.clips("test") if clip.name == "highway_white_right"]
    evaluation_set = EvaluationSet("easy", lambda: iter(()), tuple(clips))
    run = run_evaluation([ServedModel(engine)], evaluation_set).clips[engine.main_model().name]["highway_white_right"]
    figures = run.figures()
    assert figures["steadiness"]["frames"] == 221
    assert figures["steadiness"]["both_ego"] >= 0.98
    assert figures["steadiness"]["id_switches"] == 0
    ego = figures["tracked"]["ego"]
    assert ego["right"] + ego["missed"] == 30
    assert ego["precision"] >= 0.98
    assert ego["recall"] >= 0.98
    assert ego["mean_error_px_640"] <= 1.5


def test_single_images_of_the_validation_split(engine: Engine, datasets: DatasetCollection) -> None:
    """A lower bound that catches a broken model file or a broken proposal stage."""
    evaluation_set = EvaluationSet("val", lambda: datasets.frames("val"))
    figures = run_evaluation([ServedModel(engine)], evaluation_set).figures()["images"][engine.main_model().name][
        "tusimple 0313-1"
    ]
    assert figures["candidates"]["proposal_recall"]["ego"]["recall_16"] >= 0.85
    assert figures["boundaries"]["ego"]["precision"] >= 0.85
    assert figures["boundaries"]["ego"]["recall"] >= 0.85


def test_splits_share_no_frame(datasets: DatasetCollection) -> None:
    sources = [{frame.source for frame, _ in datasets.frames(split)} for split in SPLITS]
    assert [len(s) for s in sources] == [1248, 284, 67]
    assert not sources[0] & sources[1] | sources[0] & sources[2] | sources[1] & sources[2]


def test_the_clips_of_a_split_are_the_videos_that_it_labels(datasets: DatasetCollection) -> None:
    found = {split: [(clip.name, clip.frames, len(clip.labeled)) for clip in datasets.clips(split)] for split in SPLITS}
    whole = range(1_000_000)
    assert found == {
        "train": [
            ("highway_project_8s", whole, 14),
            ("highway_concrete", whole, 12),
            ("country_road_140s", range(2000), 50),
        ],
        "val": [("country_road_140s", range(2000, 2400), 10)],
        "test": [("highway_white_right", whole, 15), ("country_road_140s", range(2400, 2800), 10)],
    }
