"""The result files of a unit, which appear under their own names only when they are complete and recorded."""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Final, Literal, Protocol

from lanestream.writing import writing
from lanestream_client.batch.parquet import ParquetTables
from lanestream_client.sinks import JsonLinesSink

if TYPE_CHECKING:
    from lanestream_client.frames import StreamResult

Format = Literal["jsonl", "parquet"]

# The folders of the result files, and which of them a format has.
FRAMES: Final = "frames"
LANES: Final = "lanes"
TRACKS: Final = "geojson"
FOLDERS: Final = (FRAMES, LANES, TRACKS)
_PART_SUFFIX: Final = ".part"


@dataclass(frozen=True)
class PartFile:
    """A complete result file that still has its temporary name: both names below the folder of the batch."""

    part: str
    final: str


class _Tables(Protocol):
    """Writes the results of a unit's frames in one format. Its methods raise OSError."""

    def write(self, path: str, result: StreamResult) -> None: ...

    def close(self) -> None: ...

    def abandon(self) -> None: ...


class UnitWriter:
    """Writes the results of a unit's frames to files in the folder `out`."""

    def __init__(self, out: Path, tables: _Tables) -> None:
        self._out = out
        self._tables = tables

    def write(self, path: str, result: StreamResult) -> None:
        """Writes the result of one frame of the file at `path`. Raises WriteError."""
        with writing(self._out):
            self._tables.write(path, result)

    def close(self) -> None:
        """Writes what is left. Raises WriteError."""
        with writing(self._out):
            self._tables.close()

    def abandon(self) -> None:
        """Writes nothing more."""
        self._tables.abandon()


class UnitFiles:
    """The result files of one unit while they are written. Their temporary names are theirs alone.

    So that two workers that got the same unit, as can happen on a cluster, do not disturb each other.
    """

    def __init__(self, out: Path, name: str) -> None:
        self._out = out
        self._name = name
        self._token = uuid.uuid4().hex
        self._open: list[tuple[PartFile, IO[bytes]]] = []

    def create(self, folder: str, suffix: str) -> IO[bytes]:
        """Returns a new file that will be `folder`/NAME.`suffix`, open for writing. Raises OSError."""
        # A name with a dot in front is not read by programs that read all files of the folder.
        names = PartFile(
            f"{folder}/.{self._name}.{self._token}{_PART_SUFFIX}",
            f"{folder}/{self._name}.{suffix}",
        )
        file = (self._out / names.part).open("wb")
        self._open.append((names, file))
        return file

    def finish(self) -> tuple[PartFile, ...]:
        """Makes the files durable and returns them. Raises OSError."""
        for _, file in self._open:
            file.flush()
            os.fsync(file.fileno())
            file.close()
        return tuple(names for names, _ in self._open)

    def discard(self) -> None:
        """Removes the files."""
        for names, file in self._open:
            with suppress(OSError):
                file.close()
            with suppress(OSError):
                (self._out / names.part).unlink()


class JsonLines:
    """Writes one line per frame, like `lanestream stream --jsonl`, each with its file."""

    def __init__(self, create: Callable[[str, str], IO[bytes]]) -> None:
        self._file = create(FRAMES, "jsonl")

    def write(self, path: str, result: StreamResult) -> None:
        """Writes the result of one frame."""
        named = replace(result, frame=replace(result.frame, name=path))
        self._file.write(JsonLinesSink.line(named).encode())

    def close(self) -> None:
        """Does nothing: every line was written at once."""

    def abandon(self) -> None:
        """Does nothing."""


@contextmanager
def unit_files(out: Path, name: str) -> Iterator[UnitFiles]:
    """Yields the result files of a unit, and removes them if the block fails. Raises WriteError."""
    files = UnitFiles(out, name)
    try:
        yield files
    except BaseException:
        files.discard()
        raise


@contextmanager
def unit_writer(files: UnitFiles, out: Path, kind: Format) -> Iterator[UnitWriter]:
    """Yields the writer of a unit's results, and closes it unless the block fails. Raises WriteError."""
    with writing(out):
        writer = UnitWriter(out, ParquetTables(files.create) if kind == "parquet" else JsonLines(files.create))
    try:
        yield writer
        writer.close()
    except BaseException:
        writer.abandon()
        raise


def create_folders(out: Path, kind: Format, tracks: bool) -> None:
    """Creates the folders of the result files. Raises WriteError."""
    folders = [FRAMES, *([LANES] if kind == "parquet" else []), *([TRACKS] if tracks else [])]
    with writing(out):
        for folder in folders:
            (out / folder).mkdir(parents=True, exist_ok=True)


def publish(out: Path, parts: tuple[PartFile, ...]) -> None:
    """Gives complete files their own names. Those that have them already are left. Raises WriteError."""
    with writing(out):
        for each in parts:
            with suppress(FileNotFoundError):
                (out / each.part).replace(out / each.final)


def sync_folders(out: Path, parts: tuple[PartFile, ...]) -> None:
    """Makes the entries of new files in their folders durable. Raises WriteError."""
    with writing(out):
        for folder in {(out / each.part).parent for each in parts}:
            descriptor = os.open(folder, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)


def remove_files(out: Path, parts: tuple[PartFile, ...]) -> None:
    """Removes complete files that are not to be published. Raises WriteError."""
    with writing(out):
        for each in parts:
            (out / each.part).unlink(missing_ok=True)


def remove_parts(out: Path) -> None:
    """Removes the files of units that were never completed. Raises WriteError."""
    with writing(out):
        for folder in FOLDERS:
            for path in (out / folder).glob(f".*{_PART_SUFFIX}"):
                path.unlink(missing_ok=True)
