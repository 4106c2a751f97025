"""Where a run's patches come from: rendered scenes and labelled real frames, cut once and kept in a folder."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lanestream.errors import LabelError
from lanestream.inference.providers import cpu_threads
from lanestream_exporter.datasets.splits import data_root
from lanestream_exporter.patchstore import PatchStore, read_stores
from lanestream_exporter.rendering import files_of, real_store, rendered_stores
from lanestream_exporter.training.classifier import PatchSource
from lanestream_exporter.training.config import PatchData
from lanestream_exporter.training.ownframes import own_stores

_LIST = "patches.json"


@dataclass(frozen=True)
class PatchFiles:
    """The files of one kind of patches, `rendered` or `real`: to train on, and to validate with."""

    name: str
    train: tuple[Path, ...]
    check: tuple[Path, ...]

    def read(self) -> PatchSource:
        """The patches in the files. Raises LabelError where there are too few."""
        return PatchSource(self.name, read_stores(self.train), read_stores(self.check))


def patch_files(data: PatchData, folder: Path, root: Path | None, done: Callable[[int, int], None]) -> list[PatchFiles]:
    """The patches that `data` asks for, as files in `folder`; they are made where they are missing.

    `root` is the folder of the project's real frames, where it is not the default one. `done` is told (how many more
    scenes are rendered, how many there are). Raises LabelError for frames that can't be used.
    """
    files: list[PatchFiles] = []
    if data.train:
        train, check = own_stores(data, folder)
        files.append(PatchFiles("real", (train,), (check,)))
    elif data.wants_real:
        real = data_root(root)
        files.append(PatchFiles("real", (real_store(folder, real, "train"),), (real_store(folder, real, "val"),)))
    if data.rendered_scenes:
        # The first file validates; scenes of the others are trained on.
        scenes = [data.validation_scenes, *files_of(data.rendered_scenes)]
        paths = rendered_stores(folder, scenes, cpu_threads(), lambda more: done(more, sum(scenes)))
        files.append(PatchFiles("rendered", tuple(paths[1:]), tuple(paths[:1])))
    return files


def origin_of(data: PatchData) -> dict[str, Any]:
    """What to remember of where a run's patches came from, in plain types."""
    if data.train:
        real = ", ".join(frames.path for frames in data.train)
    else:
        real = "TuSimple 0313-1 and Udacity, training splits" if data.wants_real else "none"
    return {"real_frames": real, "rendered_scenes": data.rendered_scenes}


def remember_files(run: Path, files: Sequence[PatchFiles]) -> None:
    """Notes in the folder of a run which patches it learns from."""
    run.mkdir(parents=True, exist_ok=True)
    noted = {part.name: {"train": _names(part.train), "check": _names(part.check)} for part in files}
    (run / _LIST).write_text(json.dumps(noted, indent=2) + "\n", encoding="utf-8")


def patches_of_run(run: Path) -> tuple[PatchStore, PatchStore] | None:
    """Patches that a run was trained on and those that it was validated with, real ones where it had any.

    None where `run` is no folder of a classifier's run. Raises LabelError where its patches are gone.
    """
    path = run / _LIST
    if not path.is_file():
        return None
    try:
        noted = json.loads(path.read_text(encoding="utf-8"))
        part = noted["real"] if "real" in noted else noted["rendered"]
        train, check = (tuple(Path(name) for name in part[use]) for use in ("train", "check"))
    except (ValueError, KeyError, TypeError) as error:
        raise LabelError(f"{path} is not a list of patches", "train again to have it written anew") from error
    return read_stores(train), read_stores(check)


def _names(paths: Sequence[Path]) -> list[str]:
    return [str(path.absolute()) for path in paths]
