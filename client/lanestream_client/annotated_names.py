"""Names for the annotated images of a run, no two of which are the same."""

from __future__ import annotations

import os
import unicodedata
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Final

_SUFFIX: Final = ".lanes.jpg"
# The longest name of a file in bytes on the usual file systems.
_LONGEST_NAME: Final = 255


def annotated_names(files: Sequence[Path]) -> list[str]:
    """Returns a file name for the annotated image of each file: its name, with its folders if others have that name.

    Names that differ in case, or in the form of their accents, count as the same: some file systems keep only one.
    """
    shared = Counter(_key(file.name) for file in files)
    taken: set[str] = set()
    names = []
    for file in files:
        candidates = _candidates(file, 1 if shared[_key(file.name)] == 1 else 2)
        name = next(name for name in candidates if _key(name) not in taken)
        taken.add(_key(name))
        names.append(name)
    return names


def _candidates(file: Path, depth: int) -> Iterator[str]:
    """Yields names with more and more of the file's folders, from `depth` parts of its path on, then numbered ones."""
    parts = file.absolute().parts[1:]
    for start in range(len(parts) - depth, -1, -1):
        yield _short("-".join(parts[start:]), _SUFFIX)
    for number in count(2):
        yield _short(file.name, f".{number}{_SUFFIX}")


def _short(name: str, suffix: str) -> str:
    """Returns the name with the suffix; the front of a name that would be too long is cut off."""
    kept = os.fsencode(name)[-(_LONGEST_NAME - len(suffix)) :]
    while len(kept) < len(os.fsencode(name)) and kept and kept[0] & 0xC0 == 0x80:  # the rest of a character
        kept = kept[1:]
    return os.fsdecode(kept) + suffix


def _key(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()
