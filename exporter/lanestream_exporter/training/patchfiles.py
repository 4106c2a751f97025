"""The patches of a run: the files that they are in, and what is read from them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lanestream.errors import LabelError
from lanestream_exporter.patchstore import PatchStore, read_stores

_LIST = "patches.json"


@dataclass(frozen=True)
class PatchSource:
    """Patches of one kind, `rendered` or `real`: those to train on, and those that choose the best network.

    Raises LabelError where either lacks true or false patches.
    """

    name: str
    train: PatchStore
    check: PatchStore

    def __post_init__(self) -> None:
        for store, use in ((self.train, "train on"), (self.check, "validate with")):
            for label, verdict in ((1, "true"), (0, "false")):
                if not (store.labels == label).any():
                    raise LabelError(f"there are no {verdict} {self.name} patches to {use}", "give more frames")

    @property
    def counts(self) -> dict[str, int]:
        """How many patches there are, and how many of them are true."""
        return {
            "train": len(self.train),
            "train_true": int(self.train.labels.sum()),
            "check": len(self.check),
            "check_true": int(self.check.labels.sum()),
        }


@dataclass(frozen=True)
class PatchFiles:
    """The files of one kind of patches, `rendered` or `real`: to train on, and to validate with."""

    name: str
    train: tuple[Path, ...]
    check: tuple[Path, ...]

    def read(self) -> PatchSource:
        """The patches in the files. Raises LabelError where there are too few."""
        return PatchSource(self.name, read_stores(self.train), read_stores(self.check))


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
