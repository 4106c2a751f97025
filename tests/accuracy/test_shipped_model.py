"""The shipped model on real frames that it was never trained on: what the README promises, with room for rounding."""

from __future__ import annotations

from pathlib import Path

import pytest

from lanestream.engine import SHIPPED_MODEL, Engine, load_engine
from lanestream_exporter.datasets.splits import highway_clip, real_frames
from lanestream_exporter.evaluation.measuring import Material, evaluate
from lanestream_exporter.evaluation.methods import ServedModel


@pytest.fixture(scope="module")
def engine() -> Engine:
    return load_engine(provider="cpu")


def test_the_shipped_files_are_small() -> None:
    sizes = [path.stat().st_size for path in SHIPPED_MODEL.parent.glob("*.onnx")]
    assert sizes
    assert max(sizes) <= 25e6
    assert sum(sizes) <= 60e6


def test_the_easy_clip_is_tracked_exactly(engine: Engine, data: Path) -> None:
    material = Material("easy", lambda: (), (highway_clip(data, "highway_white_right"),))
    run = evaluate([ServedModel(engine)], material).clips[engine.network.name]["highway_white_right"]
    figures = run.figures()
    assert figures["steadiness"]["frames"] == 221
    assert figures["steadiness"]["both_ego"] >= 0.98
    assert figures["steadiness"]["id_switches"] == 0
    ego = figures["tracked"]["ego"]
    assert ego["right"] + ego["missed"] == 30
    assert ego["precision"] >= 0.98
    assert ego["recall"] >= 0.98
    assert ego["mean_error_px_640"] <= 1.5


def test_single_images_of_the_validation_split(engine: Engine, data: Path) -> None:
    """A floor, not a figure to be proud of: it catches a broken model file or a broken proposal stage."""
    material = Material("val", lambda: real_frames(data, "val"))
    figures = evaluate([ServedModel(engine)], material).figures()["images"][engine.network.name]["tusimple 0313-1"]
    assert figures["candidates"]["proposal_recall"]["ego"]["recall_16"] >= 0.85
    assert figures["boundaries"]["ego"]["precision"] >= 0.85
    assert figures["boundaries"]["ego"]["recall"] >= 0.85


def test_splits_share_no_frame(data: Path) -> None:
    sources = [{frame.source for frame, _ in real_frames(data, split)} for split in ("train", "val", "test")]
    assert [len(s) for s in sources] == [188, 27, 67]
    assert not sources[0] & sources[1] | sources[0] & sources[2] | sources[1] & sources[2]
