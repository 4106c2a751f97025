"""The files of a data set: its folder, which labels may not point out of, and JSON read with line numbers."""

from __future__ import annotations

import codecs
import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from lanestream.errors import LabelError, LanestreamError

# Folders of labels that usually stand next to the folder of images rather than above it.
_LABEL_FOLDERS: Final = frozenset({"labels", "annotations", "json"})
IMAGE_FOLDERS: Final = ("images", "image", "imgs", "img", "frames")
IMAGE_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".webp")
_VIDEO_SUFFIXES: Final = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".ts", ".wmv")
_JSON_LINES: Final = "one JSON object per line is accepted"
_START_BYTES: Final = 1 << 16
_UTF_16_MARKS: Final = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


@dataclass(frozen=True)
class DataFolder:
    """The folder of a data set and its label files, sorted; `files` is a single file if the data set is one file.

    If that file lies in a folder `labels`, `annotations` or `json`, `root` is the folder above, which has the images.
    """

    root: Path
    files: tuple[Path, ...]

    @classmethod
    def at(cls, path: Path) -> DataFolder:
        """Returns the data set at `path`, a folder or one label file. Raises LabelError if nothing is there."""
        if path.is_file():
            is_label_folder = path.absolute().parent.name.lower() in _LABEL_FOLDERS
            return cls(path.parent / ".." if is_label_folder else path.parent, (path,))
        if not path.is_dir():
            raise LabelError(f"there is nothing at {path}", "give a folder of labeled frames, or a label file")
        return cls(
            path, tuple(sorted(file for file in path.rglob("*") if file.is_file() and not _is_hidden(file, path)))
        )

    def with_suffix(self, *suffixes: str) -> list[Path]:
        """Returns the files whose names end in one of `suffixes`."""
        return [file for file in self.files if file.name.lower().endswith(suffixes)]

    def find(self, *paths: Path) -> Path:
        """Returns the first of `paths` that is a file.

        Raises LabelError if none is, or if one of them is outside the folder, whether or not it exists: labels from
        a third party must not make other files readable. Links inside the folder are followed. A suffix may be in
        upper case in one place and in lower case in the other.
        """
        root = _normalized(self.root)
        for path in paths:
            if not _normalized(path).is_relative_to(root):
                raise LabelError(
                    f"{path} is outside the data set's folder", "give the folder that holds both labels and images"
                )
        for path in paths:
            found = next(filter(_is_file, _spellings(path)), None)
            if found is not None:
                return found
        raise LabelError(f"there is no file {_normalized(paths[0]).relative_to(root)}")

    def find_image(self, path: Path) -> Path:
        """Returns the image at `path`, which has no suffix. Raises LabelError as `find` does."""
        return self.find(*(path.with_name(path.name + suffix) for suffix in IMAGE_SUFFIXES))

    def find_video(self, name: Path, labels: Path) -> Path:
        """Returns the video `name` of the label file `labels`. Raises LabelError as `find` does.

        It is looked for next to the labels, in the folders `clips` and `videos` of the data set, and at its root. If
        `name` has no suffix of a video, any is accepted.
        """
        is_whole = name.suffix.lower() in _VIDEO_SUFFIXES
        names = [name] if is_whole else [name.with_name(name.name + suffix) for suffix in (*_VIDEO_SUFFIXES, "")]
        folders = labels.parent, self.root / "clips", self.root / "videos", self.root
        return self.find(*(folder / each for folder in folders for each in names))

    def name(self, path: Path) -> str:
        """Returns the name of `path` within the data set."""
        return _normalized(path).relative_to(_normalized(self.root)).as_posix()


def natural_key(name: str) -> list[tuple[int, str]]:
    """Returns what to sort file names by, so that 2.jpg comes before 10.jpg."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name.lower())]


def drive_of(folder: Path) -> str:
    """Returns the name of the drive or clip whose images are in `folder`, whichever path leads there.

    The name is the last two parts of the path, leaving out folders that only say that they hold images.
    """
    return "/".join([part for part in _normalized(folder).parts if part.lower() not in IMAGE_FOLDERS][-2:])


def path_in_labels(name: str) -> Path:
    """Returns the path that a label file gives, with either kind of slash. Raises TypeError if it is not a path."""
    if not isinstance(name, str) or not name:
        raise TypeError(f"{name!r} is not a path")
    return Path(name.replace("\\", "/"))


def read_json_lines(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yields (location, object) of each line in `path` that is not blank; locations are `file:line`.

    Raises LabelError for bad lines.
    """
    for location, record in scan_json_lines(path):
        if isinstance(record, LabelError):
            raise record
        yield location, record


def scan_json_lines(path: Path) -> Iterator[tuple[str, dict[str, Any] | LabelError]]:
    """Like `read_json_lines`, but yields the error of a bad line instead of raising it, and continues."""
    try:
        lines = read_lines(path)
    except LabelError as error:
        yield str(path), error
        return
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        location = f"{path}:{number}"
        try:
            yield location, json_object(line, location, _JSON_LINES)
        except LabelError as error:
            yield location, error


def read_text(path: Path, accepted: str = _JSON_LINES) -> str:
    """Returns the text of the file `path`, in UTF-8 or as Windows writes it, in UTF-16 with a byte order mark.

    Raises LabelError if it can't be read or is not a text file.
    """
    try:
        return _decoded(path.read_bytes())
    except OSError as error:
        raise LabelError(f"can't read {path}: {(error.strerror or str(error)).lower()}") from None
    except UnicodeDecodeError:
        raise LabelError(f"{path} is not a text file", accepted) from None


def read_lines(path: Path, accepted: str = _JSON_LINES) -> list[str]:
    """Returns the lines of the file `path`, which end as on any system. Raises LabelError as `read_text` does."""
    # Not splitlines, which also splits at characters that may stand in the text of a label.
    return read_text(path, accepted).replace("\r\n", "\n").replace("\r", "\n").split("\n")


def start_of(path: Path) -> bytes:
    """Returns the start of the file `path` in UTF-8, to recognize its format by; nothing if it can't be read."""
    try:
        with path.open("rb") as file:
            start = file.read(_START_BYTES)
    except OSError:
        return b""
    return start.decode("utf-16", errors="ignore").encode() if start.startswith(_UTF_16_MARKS) else start


def json_object(text: str, location: str, accepted: str) -> dict[str, Any]:
    """Returns the JSON object in `text`. Raises LabelError that names the `location` and what is `accepted` there."""
    found = json_value(text, location, accepted)
    if not isinstance(found, dict):
        raise LabelError(f"{location}: not a JSON object", accepted)
    return found


def json_value(text: str, location: str, accepted: str) -> Any:
    """Returns the JSON value in `text`. Raises LabelError that names the `location` and what is `accepted` there."""
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise LabelError(f"{location}: not JSON: {error.msg}", accepted) from None
    except (RecursionError, ValueError):
        raise LabelError(f"{location}: not readable JSON: nested too deeply, or a number too long", accepted) from None


def error_at(location: str, error: LanestreamError) -> LabelError:
    """Returns `error` as the error of the record at `location`."""
    return LabelError(f"{location}: {error.message}", error.hint)


def field_error(location: str, error: Exception, needed: str) -> LabelError:
    """Returns the error of a record at `location` whose fields are missing or have other types than `needed`."""
    reason = f"there is no {error}" if isinstance(error, KeyError) else str(error)
    return LabelError(f"{location}: {reason}", f"a record needs {needed}")


def _normalized(path: Path) -> Path:
    return Path(os.path.normpath(path.absolute()))


def _is_hidden(path: Path, root: Path) -> bool:
    """Whether a program keeps the file `path` below `root` for itself, such as the ._NAME files of macOS."""
    return any(part.startswith(".") for part in path.relative_to(root).parts)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that is longer than the system allows
        return False


def _decoded(data: bytes) -> str:
    return data.decode("utf-16" if data.startswith(_UTF_16_MARKS) else "utf-8-sig")


def _spellings(path: Path) -> Iterator[Path]:
    """Yields `path`, then with its suffix in lower and in upper case."""
    yield path
    for suffix in (path.suffix.lower(), path.suffix.upper()):
        if suffix != path.suffix:
            yield path.with_suffix(suffix)
