"""The data of a run: labeled frames of a manifest, rendered scenes, the ego-lane prior; and interrupting a run."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from labelfiles import write_manifest
from numpy.typing import NDArray

from lanestream.detection.interface import ModelRole
from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR, load_engine
from lanestream.errors import LabelError, ModelError, SettingsError
from lanestream.inference.model_info import ClassifierInfo
from lanestream_exporter.samples.cache import SAMPLES_VERSION
from lanestream_exporter.samples.patch_files import RENDERED, PatchCache, read_stores, write_store
from lanestream_exporter.samples.patches import Patches, PatchMaker
from lanestream_exporter.samples.prior_regressor import load_prior_regressor
from lanestream_exporter.samples.truth import MARKING, NOTHING, ROAD_EDGE
from lanestream_exporter.scenes import render_still, sample_scene
from lanestream_exporter.training.config import TrainingData
from lanestream_exporter.training.data_sources import PatchFiles, frame_sources, open_datasets, patch_files

INTERRUPTED = """
import signal
from lanestream_exporter.training_commands import interruptible

before = signal.getsignal(signal.SIGINT)
with interruptible() as stopped:
    assert not stopped()
    signal.raise_signal(signal.SIGINT)
    assert stopped()
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        outcome = "requested, interrupted"
assert signal.getsignal(signal.SIGINT) is before
print(outcome + ", restored")
"""


def drive(folder: Path, frames: int = 2) -> Path:
    """Writes rendered images with LabelMe labels to `folder`."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(len(folder.name))
    for number in range(frames):
        still = render_still(sample_scene(rng, 320, 240))
        cv2.imwrite(str(folder / f"{number}.jpg"), still.image)
        shapes = [{"label": "lane", "shape_type": "linestrip", "points": p.points.tolist()} for p in still.labels.lanes]
        (folder / f"{number}.json").write_text(json.dumps({"imagePath": f"{number}.jpg", "shapes": shapes}))
    return folder


def two_drives(folder: Path) -> TrainingData:
    """Writes two drives and their manifest; returns the data of a recipe that trains on real frames alone."""
    drive(folder / "roads" / "one")
    drive(folder / "roads" / "three")
    manifest = write_manifest(
        folder / "datasets.toml",
        {"name": "one", "path": "roads/one", "split": "train"},
        {"name": "three", "path": "roads/three", "split": "val"},
    )
    return TrainingData(manifest=str(manifest), rendered_scenes=0, real_share=1.0, final_real_share=1.0)


def cut(data: TrainingData, folder: Path) -> PatchFiles:
    (files,) = patch_files(data, open_datasets(data, folder), PatchCache(folder / "patches", 112), lambda *_: None)
    return files


def test_patches_are_cut_once_and_again_if_frames_change(tmp_path: Path) -> None:
    data = two_drives(tmp_path)
    first = cut(data, tmp_path)
    before = [path.stat().st_mtime_ns for path in (*first.train, *first.check)]
    assert cut(data, tmp_path) == first
    assert [path.stat().st_mtime_ns for path in (*first.train, *first.check)] == before
    record = json.loads((tmp_path / "roads/one/0.json").read_text())
    (tmp_path / "roads/one/0.json").write_text(json.dumps(record, indent=1))
    assert cut(data, tmp_path) != first


def test_frames_of_the_manifest_train_and_validate_the_regressor(tmp_path: Path) -> None:
    data = two_drives(tmp_path)
    (source,) = frame_sources(data, open_datasets(data, tmp_path), tmp_path / "frames", lambda *_: None)
    assert {frame.group for frame in source.train} == {"roads/one"}
    assert {frame.group for frame in source.check} == {"roads/three"}


def test_a_manifest_without_validation_frames_is_refused(tmp_path: Path) -> None:
    data = two_drives(tmp_path)
    write_manifest(tmp_path / "datasets.toml", {"name": "one", "path": "roads/one", "split": "train"})
    with pytest.raises(LabelError, match="the manifest puts no frames into the split 'val'"):
        open_datasets(data, tmp_path)


def test_without_real_shares_no_data_set_is_opened(tmp_path: Path) -> None:
    assert open_datasets(TrainingData(real_share=0.0, final_real_share=0.0), tmp_path / "gone") is None


def test_rendered_scenes_are_spread_over_files_and_the_first_validates(tmp_path: Path) -> None:
    data = TrainingData(rendered_scenes=3, validation_scenes=2, real_share=0.0, final_real_share=0.0)
    (tmp_path / "rendered-64-1-0000-2.npz").write_bytes(b"samples of an older version")
    calls: list[tuple[int, int]] = []
    cache = PatchCache(tmp_path, 64)
    (files,) = patch_files(data, None, cache, lambda more, total: calls.append((more, total)))
    assert sum(more for more, _ in calls) == calls[-1][1] == 5
    assert [path.name for path in (*files.check, *files.train)] == [
        f"rendered-64-{SAMPLES_VERSION}-0000-2.npz",
        f"rendered-64-{SAMPLES_VERSION}-0001-3.npz",
    ]
    source = files.read()
    assert source.counts["train"]["patches"] == len(source.train) > 0
    assert source.counts["check"]["sets"] == {RENDERED: len(source.check)}


def stored(path: Path, *targets: tuple[int, int, int]) -> Path:
    """Writes black patches with these targets."""
    write_store(path, [("mine", Patches(np.zeros((len(targets), 64, 64, 3), np.uint8), np.array(targets, np.int8)))])
    return path


def test_a_source_needs_patches_with_and_without_a_boundary(tmp_path: Path) -> None:
    nothing = stored(tmp_path / "nothing.npz", (NOTHING, -1, -1))
    edges = stored(tmp_path / "edges.npz", (ROAD_EDGE, -1, -1), (NOTHING | ROAD_EDGE, -1, -1))
    with pytest.raises(LabelError, match="no real patches of boundaries to train on"):
        PatchFiles("real", (nothing,), (edges,)).read()
    with pytest.raises(LabelError, match="no real patches without a boundary to train on"):
        PatchFiles("real", (edges,), (edges, nothing)).read()
    with pytest.raises(LabelError, match="no real patches of boundaries to validate with"):
        PatchFiles("real", (nothing, edges), (nothing,)).read()
    # A few frames whose labels leave much unknown may have no other patches to validate with; rendered scenes have.
    PatchFiles("real", (nothing, edges), (edges,)).read()


def test_a_source_counts_its_patches(tmp_path: Path) -> None:
    path = stored(
        tmp_path / "all.npz",
        (NOTHING, -1, -1),
        (MARKING, 1, 0),
        (MARKING, 3, -1),
        (ROAD_EDGE, -1, -1),
        (MARKING | ROAD_EDGE, -1, 1),
    )
    assert PatchFiles("real", (path,), (path,)).read().counts["train"] == {
        "patches": 5, "nothing": 1, "marking": 2, "road_edge": 1,
        "solid": 0, "dashed": 1, "double": 0, "dots": 1, "white": 1, "yellow": 1, "sets": {"mine": 5},
    }  # fmt: skip


def test_a_data_set_can_be_left_out(tmp_path: Path) -> None:
    data = two_drives(tmp_path)
    drive(tmp_path / "roads" / "other")
    write_manifest(
        tmp_path / "datasets.toml",
        {"name": "one", "path": "roads/one", "split": "train"},
        {"name": "other", "path": "roads/other", "split": "train"},
        {"name": "three", "path": "roads/three", "split": "val"},
    )

    def groups(*without: str) -> set[str]:
        chosen = data.model_copy(update={"without": without})
        (source,) = frame_sources(chosen, open_datasets(chosen, tmp_path), tmp_path / "frames", lambda *_: None)
        assert {(frame.dataset, frame.group) for frame in source.check} == {("three", "roads/three")}
        return {frame.dataset for frame in source.train}

    assert groups() == {"one", "other"}
    assert groups("other") == {"one"}
    with pytest.raises(SettingsError, match=r"the manifest has no data set 'two'.*its data sets are one, other, three"):
        groups("two")


def test_the_first_interrupt_is_a_request_and_the_second_interrupts() -> None:
    # In a separate process: libraries that other tests load may handle signals themselves.
    done = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "requested, interrupted, restored\n", "")


def test_with_a_regressor_candidates_are_proposed_as_served(tmp_path: Path) -> None:
    engine = load_engine(provider="cpu")
    still = render_still(sample_scene(np.random.default_rng(8), 640, 360))
    searched: list[NDArray[np.uint8]] = []

    def infer(role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        if role == "classifier":
            searched.append(inputs)
        return engine.models[role].run(inputs)

    engine.open_session().process(still.image, 0.0, infer)
    info = engine.main_model().info
    assert isinstance(info, ClassifierInfo)
    with_prior, alone = (
        maker.proposed(still.image, still.labels, maker.propose(still.image)).pixels
        for maker in (PatchMaker(info.patch, load_prior_regressor(SHIPPED_REGRESSOR)), PatchMaker(info.patch))
    )
    (served,) = searched
    np.testing.assert_array_equal(with_prior, served)
    assert not np.array_equal(alone, served)
    paths = [
        PatchCache(tmp_path, 64, file).labeled("real", lambda: iter([(still.labels, still.image)]), to_train=False)
        for file in (SHIPPED_REGRESSOR, None)
    ]
    stores = [read_stores([path]) for path in paths]
    assert 0 < len(stores[0]) <= len(served)
    assert stores[0].data.tolist() != stores[1].data.tolist()


def test_a_file_that_is_not_a_regressor_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"can't read .*gone\.onnx: no such file"):
        PatchCache(tmp_path, 64, tmp_path / "gone.onnx").labeled("real", lambda: iter(()), to_train=False)
    with pytest.raises(ModelError, match=r"classifier\.onnx is not a regressor"):
        PatchCache(tmp_path, 64, SHIPPED_MODEL).labeled("real", lambda: iter(()), to_train=False)
