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
from lanestream.errors import LabelError, ModelError
from lanestream.inference.model_info import ClassifierInfo
from lanestream_exporter.samples.patch_files import PatchCache, read_stores, write_store
from lanestream_exporter.samples.patches import PatchMaker
from lanestream_exporter.samples.prior_regressor import load_prior_regressor
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
        "rendered-64-4-0000-2.npz",
        "rendered-64-4-0001-3.npz",
    ]
    source = files.read()
    assert source.counts["train"] == len(source.train) > len(source.check) > 0


def test_a_source_without_false_patches_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "true.npz"
    write_store(path, [(np.zeros((224, 224, 3), np.uint8), 1)])
    with pytest.raises(LabelError, match="no false real patches to train on"):
        PatchFiles("real", (path,), (path,)).read()


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
        maker.proposed(still.image, still.labels, maker.propose(still.image))[0]
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
    assert list(stores[0].labels) != list(stores[1].labels)


def test_a_file_that_is_not_a_regressor_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"can't read .*gone\.onnx: no such file"):
        PatchCache(tmp_path, 64, tmp_path / "gone.onnx").labeled("real", lambda: iter(()), to_train=False)
    with pytest.raises(ModelError, match=r"classifier\.onnx is not a regressor"):
        PatchCache(tmp_path, 64, SHIPPED_MODEL).labeled("real", lambda: iter(()), to_train=False)
