"""Files that commands write: checked before the work, and reported on one line if they can't be written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import Final

from lanestream.errors import WriteError

# Enough to notice a full disk before the work.
_PROBE: Final = bytes(1 << 16)


def check_folder(folder: Path) -> None:
    """Creates the folder if it is missing. Raises WriteError if nothing can be written to it."""
    with writing(folder):
        _probe(folder)


def check_file(path: Path) -> None:
    """Creates the folder of a file that will be written later. Raises WriteError if it can't be written."""
    if path.is_dir():
        raise WriteError(f"can't write {path}: it is a folder", "give the path of a file")
    if path.exists() and not path.is_file():  # a device or a pipe
        return
    if path.exists() and not os.access(path, os.W_OK):
        raise WriteError(f"can't write {path}: permission denied")
    with writing(path):
        _probe(path.parent)


def _probe(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryFile(dir=folder) as file:
        file.write(_PROBE)
        file.flush()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Converts an OSError in the block to a WriteError that names `path`. A closed pipe stays what it is."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise WriteError(f"can't write {path}: {(error.strerror or str(error)).lower()}") from None
