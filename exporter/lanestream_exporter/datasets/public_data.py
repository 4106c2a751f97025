"""The public data sets of the shipped manifest: where each comes from, and whether the user's copy is whole.

Nothing is downloaded: the originals have no stable direct links, and were changed before training.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field

from lanestream.errors import SettingsError
from lanestream_exporter.toml_files import CONFIG_FOLDER, Section, read_toml

FOLDER: Final = CONFIG_FOLDER / "data"
_SOURCES, CHECKSUMS = FOLDER / "sources.toml", FOLDER / "checksums.toml"
_HINT: Final = "reinstall the package"

State = Literal["present", "missing", "different"]


class PublicSource(Section):
    """A public data set, as sources.toml describes its fields."""

    folder: str
    title: str
    page: str
    commit: str | None = None
    license: str
    download: str
    prepare: str
    files: tuple[str, ...]
    images: tuple[str, ...]


class FileSum(Section):
    """The size in bytes and the SHA-256 of a file."""

    path: str
    bytes: int
    sha256: str


class FolderSum(Section):
    """The number of files in a folder and their total size in bytes."""

    path: str
    files: int
    bytes: int


class _Sources(Section):
    source: Annotated[tuple[PublicSource, ...], Field(min_length=1)]


class _Checksums(Section):
    file: tuple[FileSum, ...]
    folder: tuple[FolderSum, ...]


@dataclass(frozen=True)
class SourceStatus:
    """A public data set with the state of the user's copy, and what is missing or different in it."""

    source: PublicSource
    state: State
    problems: tuple[str, ...]


def public_sources(name: str | None = None) -> tuple[PublicSource, ...]:
    """Returns all public data sets, or the one named `name`. Raises SettingsError for an unknown name."""
    sources = read_toml(_SOURCES, _Sources, _HINT).source
    chosen = tuple(source for source in sources if name in (None, source.folder))
    if not chosen:
        known = ", ".join(source.folder for source in sources)
        raise SettingsError(f"there is no public data set {name!r}", f"accepted are {known}")
    return chosen


def check_sources(sources: Sequence[PublicSource], data: Path) -> Iterator[SourceStatus]:
    """Yields the states of data sets in the data folder `data`."""
    checksums = read_toml(CHECKSUMS, _Checksums, _HINT)
    for source in sources:
        expected = {f"{source.folder}/{name}" for name in (*source.files, *source.images)}
        all_sums: tuple[FileSum | FolderSum, ...] = (*checksums.file, *checksums.folder)
        sums = [known for known in all_sums if known.path in expected]
        missing = [known.path for known in sums if not (data / known.path).exists()]
        different = [text for known in sums if known.path not in missing and (text := _difference(known, data))]
        state: State = "missing" if missing else "different" if different else "present"
        yield SourceStatus(source, state, (*(f"{path} is missing" for path in missing), *different))


def checksums_of(sources: Sequence[PublicSource], data: Path) -> dict[str, list[dict[str, Any]]]:
    """Returns the content of checksums.toml for the data folder `data`. Raises OSError if a file is missing."""
    files = [file_sum(data, f"{source.folder}/{name}") for source in sources for name in source.files]
    folders = [folder_sum(data, f"{source.folder}/{name}") for source in sources for name in source.images]
    return {"file": [each.model_dump() for each in files], "folder": [each.model_dump() for each in folders]}


def file_sum(data: Path, path: str) -> FileSum:
    """Returns size and hash of the file at `path` in the data folder. Raises OSError if it can't be read."""
    with (data / path).open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return FileSum(path=path, bytes=(data / path).stat().st_size, sha256=digest)


def folder_sum(data: Path, path: str) -> FolderSum:
    """Returns number and size of the files in the folder at `path`. Raises OSError if it can't be read."""
    sizes = [file.stat().st_size for file in (data / path).iterdir() if not file.name.startswith(".")]
    return FolderSum(path=path, files=len(sizes), bytes=sum(sizes))


def _difference(known: FileSum | FolderSum, data: Path) -> str:
    """Returns how a file or folder differs from the known one; empty if it doesn't."""
    try:
        if isinstance(known, FileSum):
            return "" if file_sum(data, known.path) == known else f"{known.path} has another content"
        found = folder_sum(data, known.path)
    except OSError as error:
        return f"{known.path} can't be read: {(error.strerror or str(error)).lower()}"
    if found.files != known.files:
        return f"{known.path} has {found.files} files instead of {known.files}"
    return "" if found == known else f"{known.path} has {found.bytes:,} bytes instead of {known.bytes:,}"
