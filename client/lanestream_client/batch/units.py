"""The work of a batch: which files its sources name, and how they are divided into units."""

from __future__ import annotations

import glob
import hashlib
import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

from lanestream.errors import SourceError, one_line
from lanestream_client.image_files import IMAGE_SUFFIXES, natural_key

VIDEO_SUFFIXES: Final = (
    *(".mp4", ".m4v", ".mov", ".3gp", ".avi", ".mkv", ".webm", ".ts", ".mts", ".m2ts", ".mpg", ".mpeg", ".vob"),
    *(".wmv", ".asf", ".flv", ".ogv", ".mjpeg", ".mjpg", ".h264", ".264", ".h265", ".hevc"),
)
# Enough that starting a unit costs nothing beside its images; few enough that little is repeated after a crash.
_IMAGES_PER_UNIT: Final = 200
_LONGEST_STEM: Final = 60
_HASH_DIGITS: Final = 12

UnitKind = Literal["video", "images"]


@dataclass(frozen=True)
class SourceFile:
    """A file as it was found: its absolute `path`, its size in bytes and its time of change in nanoseconds.

    A file that differs in any of them is another one, and is processed again.
    """

    path: str
    size: int
    mtime_ns: int

    @classmethod
    def at(cls, path: Path) -> SourceFile:
        """Returns the file at `path`. One that can't be examined, such as a dangling link, counts as empty."""
        try:
            status = path.stat()
        except OSError:
            return cls(str(_absolute(path)), 0, 0)
        return cls(str(_absolute(path)), status.st_size, status.st_mtime_ns)

    @property
    def is_image(self) -> bool:
        """Whether the name is that of an image; any other file is taken for a video."""
        return Path(self.path).suffix.lower() in IMAGE_SUFFIXES


@dataclass(frozen=True)
class Unit:
    """A part of the work that is done as a whole: a video, or some images of one folder.

    Its results go to files with its `name`, which depends on the paths of its files only.
    """

    kind: UnitKind
    files: tuple[SourceFile, ...]

    @property
    def name(self) -> str:
        """A name for files, no two of which are the same for different paths."""
        first = Path(self.files[0].path)
        readable = first.name if self.kind == "video" else first.parent.name
        # Readers of data sets skip names that begin with a dot or an underscore.
        stem = re.sub(r"[^\w.-]+", "_", readable).lstrip("._-")[:_LONGEST_STEM] or self.kind
        paths = b"\0".join(os.fsencode(file.path) for file in self.files)
        return f"{stem}-{hashlib.sha256(paths).hexdigest()[:_HASH_DIGITS]}"

    @property
    def size(self) -> int:
        """The size of its files in bytes."""
        return sum(file.size for file in self.files)

    def without(self, path: str) -> Unit | None:
        """Returns the unit without a file; None if nothing is left."""
        rest = tuple(file for file in self.files if file.path != path)
        return replace(self, files=rest) if rest else None


def find_files(sources: Sequence[str], notify: Callable[[str], object], leave_out: Path) -> list[SourceFile]:
    """Returns the videos and images that the sources name, each once, and those of a folder in natural order.

    A source is a file, a folder with all folders below it, a glob pattern, or `@FILE` with one source per line.
    `notify` gets a line that counts what else the folders hold; nothing in the folder `leave_out` is read. Raises
    SourceError if a source does not exist or is empty.
    """
    skipped: Counter[str] = Counter()
    found: dict[str, SourceFile] = {}
    for source in _expanded(sources):
        for path in _walk(source, _absolute(leave_out), skipped) if source.is_dir() else [source]:
            file = SourceFile.at(path)
            found.setdefault(file.path, file)
    if skipped:
        kinds = ", ".join(f"{kind}: {number}" for kind, number in sorted(skipped.items()))
        notify(f"skipped everything but videos and images ({kinds})")
    if not found:
        accepted = ", ".join((*VIDEO_SUFFIXES, *IMAGE_SUFFIXES))
        raise SourceError(f"no videos or images in {one_line(', '.join(sources))}", f"accepted file types: {accepted}")
    return list(found.values())


def units_of(files: Iterable[SourceFile]) -> list[Unit]:
    """Returns the units of these files, the largest first: at the end, no processor waits long for another one.

    The size is known without opening a file, and among videos of one kind it is in proportion to their length.
    """
    units = []
    folders: defaultdict[Path, list[SourceFile]] = defaultdict(list)
    for file in files:
        if file.is_image:
            folders[Path(file.path).parent].append(file)
        else:
            units.append(Unit("video", (file,)))
    for images in folders.values():
        starts = range(0, len(images), _IMAGES_PER_UNIT)
        units += [Unit("images", tuple(images[start : start + _IMAGES_PER_UNIT])) for start in starts]
    return sorted(units, key=lambda unit: -unit.size)


def _expanded(sources: Iterable[str]) -> Iterator[Path]:
    """Yields files and folders: the lines of lists and the matches of patterns. A path that exists is not a pattern."""
    for source in sources:
        if os.path.lexists(source):
            yield Path(source)
        elif source.startswith("@"):
            yield from _expanded(_lines(Path(source[1:])))
        elif glob.has_magic(source):
            matches = glob.glob(source, recursive=True)  # noqa: PTH207 - pathlib has no absolute patterns
            if not matches:
                raise SourceError(f"nothing matches {source}", "check the pattern")
            yield from map(Path, sorted(matches, key=natural_key))
        else:
            raise SourceError(f"no such file or folder: {source}", "give files, folders, patterns or @FILE")


def _lines(path: Path) -> list[str]:
    try:
        lines = path.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    except OSError as error:
        raise SourceError(
            f"can't read the list {path}: {(error.strerror or str(error)).lower()}", "give @FILE, one source per line"
        ) from None
    sources = [line for line in lines if line.strip()]
    nested = next((line for line in sources if line.startswith("@")), None)
    if nested is not None:
        raise SourceError(f"the list {path} names another list, {nested}", "give both lists as sources")
    return sources


def _walk(folder: Path, left_out: Path, skipped: Counter[str]) -> Iterator[Path]:
    """Yields the videos and images below a folder. Hidden files and folders are passed over, others are counted."""
    try:
        entries = sorted(folder.iterdir(), key=lambda path: natural_key(path.name))
    except OSError as error:
        raise SourceError(f"can't read {folder}: {(error.strerror or str(error)).lower()}") from None
    for path in entries:
        if path.name.startswith(".") or _absolute(path) == left_out:
            continue
        suffix = path.suffix.lower()
        if path.is_dir():
            if path.is_symlink():  # it may lead back to a folder above
                skipped["links to folders"] += 1
            else:
                yield from _walk(path, left_out, skipped)
        elif suffix in VIDEO_SUFFIXES or suffix in IMAGE_SUFFIXES:
            yield path
        else:
            skipped[suffix or "files without a suffix"] += 1


def _absolute(path: Path) -> Path:
    """Returns the path from the root without `..`, and with its links, so that the user recognizes it."""
    return Path(os.path.abspath(path))  # noqa: PTH100 - pathlib keeps `..`
