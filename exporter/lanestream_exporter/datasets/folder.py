"""A data set on disk: its label files, and the one folder that nothing in them may point out of."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from lanestream.errors import LabelError

# Where labels commonly stand beside their pictures rather than above them.
_LABEL_FOLDERS: Final = frozenset({"labels", "annotations", "json"})
IMAGE_FOLDERS: Final = ("images", "image", "imgs", "img", "frames")
_PICTURES: Final = (".jpg", ".jpeg", ".png", ".webp")


@dataclass(frozen=True)
class DataFolder:
    """The folder of a data set and its files, sorted; of a label file given alone, that file and its folder.

    The folder of a label file in `labels`, `annotations` or `json` is the one above, where the pictures are.
    """

    root: Path
    files: tuple[Path, ...]

    @classmethod
    def at(cls, path: Path) -> DataFolder:
        """The data set at `path`, a folder or one label file. Raises LabelError where there is nothing."""
        if path.is_file():
            above = path.absolute().parent.name in _LABEL_FOLDERS
            return cls(path.parent / ".." if above else path.parent, (path,))
        if not path.is_dir():
            raise LabelError(f"there is nothing at {path}", "give a folder of labelled frames, or a label file")
        return cls(path, tuple(sorted(file for file in path.rglob("*") if file.is_file())))

    def with_suffix(self, *suffixes: str) -> list[Path]:
        """The files whose names end in one of `suffixes`."""
        return [file for file in self.files if file.name.lower().endswith(suffixes)]

    def find(self, *places: Path) -> Path:
        """The first of `places` that is a file.

        Raises LabelError where none is, and where one is outside of the folder, whether a file is there or not: labels
        from elsewhere must not make anybody's files readable. Links that stand in the folder are followed.
        """
        root = _plain(self.root)
        for place in places:
            if not _plain(place).is_relative_to(root):
                raise LabelError(
                    f"{place} is outside of the data set's folder", "give the folder that holds both labels and images"
                )
        for place in places:
            if _is_file(place):
                return place
        raise LabelError(f"there is no file {_plain(places[0]).relative_to(root)}")

    def picture_of(self, place: Path) -> Path:
        """The picture at `place`, a path without its suffix. Raises LabelError as `find` does."""
        return self.find(*(place.with_name(place.name + suffix) for suffix in _PICTURES))

    def name(self, path: Path) -> str:
        """How `path` is called within the data set."""
        return _plain(path).relative_to(_plain(self.root)).as_posix()


def drive_of(folder: Path) -> str:
    """The name of the drive or clip whose frames are in `folder`, the same from wherever it is looked at.

    It is the folder's last two parts, without those that only say that pictures are in it.
    """
    return "/".join([part for part in _plain(folder).parts if part not in IMAGE_FOLDERS][-2:])


def relative(name: str) -> Path:
    """A path as a label file writes it, with either kind of slash. Raises TypeError where it is none."""
    if not isinstance(name, str) or not name:
        raise TypeError(f"{name!r} is no path of an image")
    return Path(name.replace("\\", "/"))


def _plain(path: Path) -> Path:
    return Path(os.path.normpath(path.absolute()))


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that is longer than the system allows
        return False
