"""The files of a data set: its folder, which labels may not point out of, and JSON read with line numbers."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from lanestream.errors import LabelError, LanestreamError

# Folders of labels that usually stand next to the folder of images rather than above it.
_LABEL_FOLDERS: Final = frozenset({"labels", "annotations", "json"})
IMAGE_FOLDERS: Final = ("images", "image", "imgs", "img", "frames")
_IMAGE_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".webp")
_JSON_LINES: Final = "one JSON object per line is accepted"


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
            is_label_folder = path.absolute().parent.name in _LABEL_FOLDERS
            return cls(path.parent / ".." if is_label_folder else path.parent, (path,))
        if not path.is_dir():
            raise LabelError(f"there is nothing at {path}", "give a folder of labeled frames, or a label file")
        return cls(path, tuple(sorted(file for file in path.rglob("*") if file.is_file())))

    def with_suffix(self, *suffixes: str) -> list[Path]:
        """Returns the files whose names end in one of `suffixes`."""
        return [file for file in self.files if file.name.lower().endswith(suffixes)]

    def find(self, *paths: Path) -> Path:
        """Returns the first of `paths` that is a file.

        Raises LabelError if none is, or if one of them is outside the folder, whether or not it exists: labels from
        a third party must not make other files readable. Links inside the folder are followed.
        """
        root = _normalized(self.root)
        for path in paths:
            if not _normalized(path).is_relative_to(root):
                raise LabelError(
                    f"{path} is outside the data set's folder", "give the folder that holds both labels and images"
                )
        for path in paths:
            if _is_file(path):
                return path
        raise LabelError(f"there is no file {_normalized(paths[0]).relative_to(root)}")

    def find_image(self, path: Path) -> Path:
        """Returns the image at `path`, which has no suffix. Raises LabelError as `find` does."""
        return self.find(*(path.with_name(path.name + suffix) for suffix in _IMAGE_SUFFIXES))

    def find_video(self, name: Path, labels: Path) -> Path:
        """Returns the video `name` of the label file `labels`. Raises LabelError as `find` does.

        It is looked for next to the labels, in the folders `clips` and `videos` of the data set, and at its root.
        """
        root = self.root
        return self.find(labels.parent / name, root / "clips" / name, root / "videos" / name, root / name)

    def name(self, path: Path) -> str:
        """Returns the name of `path` within the data set."""
        return _normalized(path).relative_to(_normalized(self.root)).as_posix()


def drive_of(folder: Path) -> str:
    """Returns the name of the drive or clip whose images are in `folder`, whichever path leads there.

    The name is the last two parts of the path, leaving out folders that only say that they hold images.
    """
    return "/".join([part for part in _normalized(folder).parts if part not in IMAGE_FOLDERS][-2:])


def path_in_labels(name: str) -> Path:
    """Returns the path that a label file gives, with either kind of slash. Raises TypeError if it is not a path."""
    if not isinstance(name, str) or not name:
        raise TypeError(f"{name!r} is not a path")
    return Path(name.replace("\\", "/"))


def read_json_lines(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yields (location, object) of each line in `path`; locations are `file:line`. Raises LabelError for bad lines."""
    for location, record in scan_json_lines(path):
        if isinstance(record, LabelError):
            raise record
        yield location, record


def scan_json_lines(path: Path) -> Iterator[tuple[str, dict[str, Any] | LabelError]]:
    """Like `read_json_lines`, but yields the error of a bad line instead of raising it, and continues."""
    try:
        lines = read_text(path).splitlines()
    except LabelError as error:
        yield str(path), error
        return
    for number, line in enumerate(lines, start=1):
        location = f"{path}:{number}"
        try:
            yield location, json_object(line, location, _JSON_LINES)
        except LabelError as error:
            yield location, error


def read_text(path: Path, accepted: str = _JSON_LINES) -> str:
    """Returns the text of the file `path`. Raises LabelError if it can't be read or is not a text file."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise LabelError(f"can't read {path}: {(error.strerror or str(error)).lower()}") from None
    except UnicodeDecodeError:
        raise LabelError(f"{path} is not a text file", accepted) from None


def json_object(text: str, location: str, accepted: str) -> dict[str, Any]:
    """Returns the JSON object in `text`. Raises LabelError that names the `location` and what is `accepted` there."""
    try:
        found = json.loads(text)
    except json.JSONDecodeError as error:
        raise LabelError(f"{location}: not JSON: {error.msg}", accepted) from None
    except (RecursionError, ValueError):
        raise LabelError(f"{location}: not readable JSON: nested too deeply, or a number too long", accepted) from None
    if not isinstance(found, dict):
        raise LabelError(f"{location}: not a JSON object", accepted)
    return found


def error_at(location: str, error: LanestreamError) -> LabelError:
    """Returns `error` as the error of the record at `location`."""
    return LabelError(f"{location}: {error.message}", error.hint)


def field_error(location: str, error: Exception, needed: str) -> LabelError:
    """Returns the error of a record at `location` whose fields are missing or have other types than `needed`."""
    reason = f"there is no {error}" if isinstance(error, KeyError) else str(error)
    return LabelError(f"{location}: {reason}", f"a record needs {needed}")


def _normalized(path: Path) -> Path:
    return Path(os.path.normpath(path.absolute()))


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that is longer than the system allows
        return False
