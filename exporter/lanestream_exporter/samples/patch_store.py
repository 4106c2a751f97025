"""Patches on disk: JPEG bytes and verdicts, in files that can be made piece by piece and read in any order."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.errors import LabelError

# High quality without chroma subsampling: the compression may not be what tells rendered patches from real ones.
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 93, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


@dataclass(frozen=True)
class PatchStore:
    """Encoded RGB patches end to end in `data`, patch i at `offsets[i]:offsets[i + 1]`, and their `labels` (N,)."""

    data: NDArray[np.uint8]
    offsets: NDArray[np.int64]
    labels: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.labels)

    def patch(self, index: int) -> NDArray[np.uint8]:
        """One RGB patch (H, W, 3)."""
        encoded = self.data[self.offsets[index] : self.offsets[index + 1]]
        return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB), dtype=np.uint8)


def write_store(path: Path, patches: Iterable[tuple[NDArray[np.uint8], int]]) -> int:
    """Writes RGB patches with their labels to `path` (.npz), whole or not at all; returns how many."""
    encoded: list[NDArray[np.uint8]] = []
    labels: list[int] = []
    for patch, label in patches:
        encoded.append(cv2.imencode(".jpg", patch[:, :, ::-1], _JPEG)[1].ravel())
        labels.append(label)
    offsets = np.cumsum([0, *(len(data) for data in encoded)])
    data = np.concatenate(encoded) if encoded else np.zeros(0, np.uint8)
    unfinished = path.with_suffix(".part.npz")
    np.savez(unfinished, data=data, offsets=offsets, labels=np.asarray(labels, dtype=np.int64))
    unfinished.replace(path)
    return len(labels)


def read_stores(paths: Sequence[Path]) -> PatchStore:
    """All patches of the files at `paths` as one store. Raises LabelError for a file that is none."""
    parts: list[PatchStore] = []
    for path in paths:
        try:
            with np.load(path, allow_pickle=False) as file:
                parts.append(PatchStore(file["data"], file["offsets"], file["labels"]))
        except (OSError, ValueError, KeyError) as error:
            raise LabelError(f"{path} is not a file of patches", "delete it to have it made again") from error
    starts = np.cumsum([0, *(len(part.data) for part in parts)])
    offsets = [part.offsets[:-1] + start for part, start in zip(parts, starts, strict=False)]
    return PatchStore(
        np.concatenate([part.data for part in parts]),
        np.concatenate([*offsets, starts[-1:]]).astype(np.int64),
        np.concatenate([part.labels for part in parts]),
    )
