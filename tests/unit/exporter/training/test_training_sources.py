"""Where patches come from: one's own frames divided by drive, rendered scenes; and how a run is interrupted."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from lanestream.detection import answered
from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR, load_engine
from lanestream.errors import LabelError, ModelError
from lanestream_exporter.samples.patch_files import PatchStores
from lanestream_exporter.samples.patch_store import read_stores, write_store
from lanestream_exporter.samples.patches import PatchMaker
from lanestream_exporter.scenes import render_still, sample_scene
from lanestream_exporter.training.config import Frames, PatchData
from lanestream_exporter.training.ownframes import own_frames, own_stores
from lanestream_exporter.training.patchfiles import PatchFiles
from lanestream_exporter.training.sources import origin_of, patch_files

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
        told = "noted, ended"
assert signal.getsignal(signal.SIGINT) is before
print(told + ", as before")
"""


def drive(folder: Path, frames: int = 2) -> Path:
    """Rendered pictures with LabelMe labels in `folder`."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(len(folder.name))
    for number in range(frames):
        still = render_still(sample_scene(rng, 320, 240))
        cv2.imwrite(str(folder / f"{number}.jpg"), still.image)
        shapes = [{"label": "lane", "shape_type": "linestrip", "points": p.points.tolist()} for p in still.labels.lanes]
        (folder / f"{number}.json").write_text(json.dumps({"imagePath": f"{number}.jpg", "shapes": shapes}))
    return folder


def own(*train: Path, validation: tuple[Path, ...] = ()) -> PatchData:
    named = [tuple(Frames(path=str(path)) for path in paths) for paths in (train, validation)]
    return PatchData(rendered_scenes=0, real_share=1.0, final_real_share=1.0, train=named[0], validation=named[1])


def test_own_frames_are_divided_by_drive(tmp_path: Path) -> None:
    for name in ("one", "three", "seven"):
        drive(tmp_path / "roads" / name)
    train, check = ({frame.group for frame, _ in part} for part in own_frames(own(tmp_path / "roads")))
    assert len(train) == 2
    assert len(check) == 1
    assert not train & check


def test_named_validation_frames_are_kept_apart_and_a_leak_is_refused(tmp_path: Path) -> None:
    a, b = drive(tmp_path / "roads" / "one"), drive(tmp_path / "more" / "three")
    train, check = ({frame.group for frame, _ in part} for part in own_frames(own(a, validation=(b,))))
    assert (train, check) == ({"roads/one"}, {"more/three"})
    with pytest.raises(LabelError, match="'roads/one' is in both train and validation"):
        own_frames(own(a, b, validation=(a,)))


def test_patches_are_cut_once_and_anew_where_frames_change(tmp_path: Path) -> None:
    a, b = drive(tmp_path / "roads" / "one"), drive(tmp_path / "roads" / "three")
    data = own(a, validation=(b,))
    first = own_stores(data, PatchStores(tmp_path / "patches", 112))
    before = [path.stat().st_mtime_ns for path in first]
    assert own_stores(data, PatchStores(tmp_path / "patches", 112)) == first
    assert [path.stat().st_mtime_ns for path in first] == before
    record = json.loads((a / "0.json").read_text())
    (a / "0.json").write_text(json.dumps(record, indent=1))
    assert own_stores(data, PatchStores(tmp_path / "patches", 112)) != first


def test_rendered_scenes_are_shared_out_and_the_first_file_validates(tmp_path: Path) -> None:
    data = PatchData(rendered_scenes=3, validation_scenes=2, real_share=0.0, final_real_share=0.0)
    (tmp_path / "rendered-64-1-0000-2.npz").write_bytes(b"scenes as an older version rendered them")
    told: list[tuple[int, int]] = []
    (files,) = patch_files(data, PatchStores(tmp_path, 64), None, lambda more, total: told.append((more, total)))
    assert sum(more for more, _ in told) == told[-1][1] == 5
    assert [path.name for path in (*files.check, *files.train)] == [
        "rendered-64-3-0000-2.npz",
        "rendered-64-3-0001-3.npz",
    ]
    source = files.read()
    assert source.counts["train"] == len(source.train) > len(source.check) > 0
    assert origin_of(data) == {"real_frames": "none", "rendered_scenes": 3}


def test_a_source_without_false_patches_says_so(tmp_path: Path) -> None:
    path = tmp_path / "true.npz"
    write_store(path, [(np.zeros((224, 224, 3), np.uint8), 1)])
    with pytest.raises(LabelError, match="no false real patches to train on"):
        PatchFiles("real", (path,), (path,)).read()


def test_the_first_interrupt_is_noted_and_the_second_ends() -> None:
    # In a process of its own: what other tests have loaded into this one may have ideas of its own about signals.
    done = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "noted, ended, as before\n", "")


def test_a_guide_proposes_candidates_as_they_are_served(tmp_path: Path) -> None:
    engine = load_engine(provider="cpu")
    still = render_still(sample_scene(np.random.default_rng(8), 640, 360))
    served, guided, alone = (
        [round(float(candidate.curve.x(300.0)), 1) for candidate in proposed.candidates]
        for proposed in (
            answered(engine.open_session().prepare(still.image)),
            PatchMaker(glance=engine.pipeline().glance).propose(still.image),
            PatchMaker().propose(still.image),
        )
    )
    assert guided == served != alone
    cut = [
        PatchStores(tmp_path, 64, guide).labelled("real", lambda: [(still.labels, still.image)], to_train=False)
        for guide in (SHIPPED_REGRESSOR, None)
    ]
    stores = [read_stores([path]) for path in cut]
    assert 0 < len(stores[0]) <= len(served)
    assert list(stores[0].labels) != list(stores[1].labels)


def test_a_guide_that_is_none_is_told(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"can't read .*gone\.onnx: no such file"):
        PatchStores(tmp_path, 64, tmp_path / "gone.onnx").labelled("real", list, to_train=False)
    with pytest.raises(ModelError, match=r"classifier\.onnx is not a regressor"):
        PatchStores(tmp_path, 64, SHIPPED_MODEL).labelled("real", list, to_train=False)
