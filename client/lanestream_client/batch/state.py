"""What a batch has done so far: an SQLite file in its folder, which a crash at any moment leaves consistent.

A unit is recorded first, with its result files under temporary names, and then the files get their own names. If that
was interrupted, the next start completes it. So a file is either not recorded and processed again, or its results are
there.
"""

from __future__ import annotations

import fcntl
import json
import os
import socket
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Final

from lanestream.errors import BatchError, WriteError
from lanestream.writing import check_folder, writing
from lanestream_client.batch.outputs import PartFile, publish, remove_files, remove_parts, sync_folders
from lanestream_client.batch.units import SourceFile, Unit

_STATE: Final = "state.sqlite"
_LOCK: Final = "lock"
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS setting (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS unit (
    id INTEGER PRIMARY KEY,
    frames INTEGER NOT NULL, failed_frames INTEGER NOT NULL, lost_frames INTEGER NOT NULL,
    boundaries INTEGER NOT NULL, both_ego INTEGER NOT NULL, video_s REAL NOT NULL
);
CREATE TABLE IF NOT EXISTS output (unit INTEGER NOT NULL REFERENCES unit, part TEXT NOT NULL, final TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS file (
    path TEXT PRIMARY KEY, size INTEGER NOT NULL, mtime_ns INTEGER NOT NULL,
    unit INTEGER REFERENCES unit, error TEXT
);
CREATE INDEX IF NOT EXISTS file_unit ON file (unit);
CREATE INDEX IF NOT EXISTS output_unit ON output (unit);
"""


@dataclass(frozen=True)
class Counts:
    """What was found in a unit, or in several.

    `frames` were processed, of which `failed_frames` have an error; `lost_frames` could not be decoded. `boundaries`
    counts those of every frame, `both_ego` the frames with both boundaries of the ego lane.
    """

    frames: int = 0
    failed_frames: int = 0
    lost_frames: int = 0
    boundaries: int = 0
    both_ego: int = 0
    video_s: float = 0.0

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(getattr(self, each.name) + getattr(other, each.name) for each in fields(Counts)))


@dataclass(frozen=True)
class UnitResult:
    """The outcome of a unit: its complete result files, and the errors of its `failed` files by path.

    `notes` are lines for the user about files that were processed.
    """

    unit: Unit
    parts: tuple[PartFile, ...] = ()
    counts: Counts = Counts()
    failed: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@contextmanager
def open_state(out: Path) -> Iterator[BatchState]:
    """Locks the folder of a batch, opens its state and repairs what a crash left.

    Raises BatchError if another batch uses the folder, and WriteError.
    """
    check_folder(out)
    with _lock(out), _database_errors(out), closing(_connect(out / _STATE)) as connection:
        state = BatchState(out, connection)
        state.repair()
        try:
            yield state
        finally:
            with suppress(WriteError):
                remove_parts(out)


class BatchState:
    """The state of the batch in the folder `out`. Only one process may use it."""

    def __init__(self, out: Path, connection: sqlite3.Connection) -> None:
        self._out = out
        self._connection = connection

    def check_settings(self, settings: Mapping[str, Any]) -> None:
        """Records the settings of the first run. Raises BatchError if they are not those of the first run."""
        before = dict(self._connection.execute("SELECT name, value FROM setting").fetchall())
        now = {name: json.dumps(value, sort_keys=True) for name, value in settings.items()}
        if not before:
            with self._connection:
                self._connection.executemany("INSERT INTO setting VALUES (?, ?)", now.items())
            return
        names = [name for name in {**now, **before} if now.get(name) != before.get(name)]
        if names:
            changes = (f"{name} was {before.get(name, 'null')}, is {now.get(name, 'null')}" for name in names)
            raise BatchError(
                f"{self._out} has results of other settings: {'; '.join(changes)}",
                "use the settings from before, or another folder for --out",
            )

    def pending(self, files: Sequence[SourceFile], retry_failed: bool) -> list[SourceFile]:
        """Returns the files that are to be processed: those without results, and failed ones if they are to be retried.

        Results of a file that has changed since are removed, together with those of the images in the same unit.
        """
        self._forget(self._outdated_units(files))
        known = self._files()
        return [
            file
            for file in files
            if file.path not in known
            or known[file.path].file != file
            or (retry_failed and known[file.path].error is not None)
        ]

    def record(self, result: UnitResult) -> bool:
        """Records a unit durably and publishes its result files.

        Returns False, and removes these files, if the unit has results already: on a cluster, a unit may be done twice.
        """
        done = {
            record.file for record in self._files([file.path for file in result.unit.files]).values() if record.unit
        }
        if done.intersection(result.unit.files):
            remove_files(self._out, result.parts)
            return False
        sync_folders(self._out, result.parts)
        counts = [getattr(result.counts, each.name) for each in fields(Counts)]
        with self._connection:
            unit = None
            if result.parts:
                names = ", ".join(each.name for each in fields(Counts))
                marks = ", ".join("?" * len(counts))
                unit = self._connection.execute(f"INSERT INTO unit ({names}) VALUES ({marks})", counts).lastrowid  # noqa: S608
                rows = [(unit, part.part, part.final) for part in result.parts]
                self._connection.executemany("INSERT INTO output VALUES (?, ?, ?)", rows)
            for file in result.unit.files:
                error = result.failed.get(file.path)
                self._connection.execute(
                    "INSERT OR REPLACE INTO file VALUES (CAST(? AS TEXT), ?, ?, ?, ?)",
                    (os.fsencode(file.path), file.size, file.mtime_ns, None if error else unit, error),
                )
        publish(self._out, result.parts)
        return True

    def failed(self, files: Iterable[SourceFile]) -> dict[str, str]:
        """Returns the errors of those files that failed, by path."""
        known = self._files()
        errors = ((file.path, known[file.path].error) for file in files if file.path in known)
        return {path: error for path, error in errors if error is not None}

    def totals(self) -> Counts:
        """Returns the sums over all units."""
        sums = ", ".join(f"SUM({each.name})" for each in fields(Counts))
        row = self._connection.execute(f"SELECT {sums} FROM unit").fetchone()  # noqa: S608
        return Counts(*(value or 0 for value in row))

    def numbers(self) -> tuple[int, int]:
        """Returns how many files have results, and how many failed."""
        row = self._connection.execute("SELECT COUNT(unit), COUNT(error) FROM file").fetchone()
        return row[0], row[1]

    def repair(self) -> None:
        """Completes what a crash interrupted, and removes files of units that were never completed. Raises WriteError.

        A unit whose results were deleted is forgotten.
        """
        rows = self._connection.execute("SELECT unit, part, final FROM output").fetchall()
        publish(self._out, tuple(PartFile(part, final) for _, part, final in rows))
        remove_parts(self._out)
        present = {
            f"{folder.name}/{path.name}"
            for folder in self._out.iterdir()
            if folder.is_dir()
            for path in folder.iterdir()
        }
        self._forget({unit for unit, _, final in rows if final not in present})

    def _outdated_units(self, files: Iterable[SourceFile]) -> set[int]:
        known = self._files()
        found = ((file, known[file.path]) for file in files if file.path in known)
        return {record.unit for file, record in found if record.unit is not None and record.file != file}

    def _forget(self, units: Iterable[int]) -> None:
        """Removes units with their result files. Interrupted, it is repeated: a unit without its files is forgotten."""
        for unit in units:
            finals = self._connection.execute("SELECT final FROM output WHERE unit = ?", (unit,)).fetchall()
            with writing(self._out):
                for (final,) in finals:
                    (self._out / final).unlink(missing_ok=True)
            with self._connection:
                for table in ("file", "output"):
                    self._connection.execute(f"DELETE FROM {table} WHERE unit = ?", (unit,))  # noqa: S608
                self._connection.execute("DELETE FROM unit WHERE id = ?", (unit,))

    def _files(self, paths: Sequence[str] | None = None) -> dict[str, _FileRecord]:
        columns = "SELECT path, size, mtime_ns, unit, error FROM file"
        if paths is None:
            rows = self._connection.execute(columns).fetchall()
        else:
            query = f"{columns} WHERE path = CAST(? AS TEXT)"
            rows = [row for path in paths for row in self._connection.execute(query, (os.fsencode(path),))]
        return {row[0]: _FileRecord(SourceFile(*row[:3]), row[3], row[4]) for row in rows}


@dataclass(frozen=True)
class _FileRecord:
    file: SourceFile
    unit: int | None
    error: str | None


@contextmanager
def _lock(out: Path) -> Iterator[None]:
    """Holds the lock of the folder, which the system releases when this process ends, however it ends."""
    with writing(out):
        file = (out / _LOCK).open("a+", encoding="utf-8")
    with file:
        with writing(out):
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                raise BatchError(
                    f"another batch writes to {out}: {file.read() or 'it has just started'}",
                    "wait until it ends, or use another folder for --out",
                ) from None
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
            file.flush()
        yield


def _connect(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(path)
    # Names of files are not always UTF-8.
    connection.text_factory = os.fsdecode
    # A record must be on the disk before the next step. No journal mode with shared memory: network folders lack it.
    connection.execute("PRAGMA synchronous = FULL")
    connection.executescript(_SCHEMA)
    return connection


@contextmanager
def _database_errors(out: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.DatabaseError as error:
        hint = "free space on the disk; if the file is damaged, use another folder for --out"
        raise WriteError(f"can't use {out / _STATE}: {error}", hint) from None
