"""The patches of a run: the files that they are in, and what is read from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lanestream.errors import LabelError
from lanestream_exporter.samples.patch_store import PatchStore, read_stores


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
