"""Where the images of an export of CVAT are: next to its XML file, in its folder `images`, or in the task's video.

Frames of a video task are called frame_000012 in the XML file, without a suffix; the number counts the frames of the
video from zero. "CVAT for video" gives numbers only. In a task of images they count the task's images, which CVAT sorts
by name unless it is set otherwise.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element

from lanestream.errors import LabelError
from lanestream_exporter.datasets.entries import size_of
from lanestream_exporter.datasets.files import IMAGE_SUFFIXES, DataFolder, drive_of, path_in_labels
from lanestream_exporter.datasets.images import ImageLocation

_FRAME_NAME: Final = re.compile(r"frame_(\d+)")
_STEP: Final = re.compile(r"step\s*=\s*(\d+)")
_IMAGES: Final = "images"
_NAME_IMAGES: Final = 'export the task as "CVAT for images 1.1", which names the images'


def frame_number(name: str) -> int | None:
    """Returns the number of a video's frame that an image element is named after; None for the image of a task."""
    found = _FRAME_NAME.fullmatch(path_in_labels(name).name)
    return None if found is None else int(found[1])


@dataclass(frozen=True)
class CvatFrame:
    """A frame's image, its name within the data set and its group, and the video and index if it was taken from one."""

    image: ImageLocation
    source: str
    group: str
    video: Path | None = None
    index: int | None = None


@dataclass(frozen=True)
class CvatExport:
    """One XML file in its folder."""

    path: Path
    root: Element
    folder: DataFolder

    def task(self, number: int = 0) -> CvatTask:
        """Returns the task that was exported, or that with the id `number` of a project."""
        paths = f"meta/project/tasks/task[id='{number}']", "meta/task"
        element = next((found for found in map(self.root.find, paths) if found is not None), None)
        return self._tasks.setdefault(number, CvatTask(self, Element("task") if element is None else element))

    @cached_property
    def size(self) -> tuple[int, int] | None:
        """The size of the frames of a video task. Raises ValueError if it is not a valid one."""
        task = self.task()
        size = [task.text(f"original_size/{side}") for side in ("width", "height")]
        return size_of(*size) if all(size) else None

    @cached_property
    def _tasks(self) -> dict[int, CvatTask]:
        return {}


@dataclass(frozen=True)
class CvatTask:
    """A task of an export, with the `element` that describes it."""

    export: CvatExport
    element: Element

    def text(self, path: str) -> str:
        """Returns the text at `path` in the task's description, which in old exports stands next to it."""
        found = self.element.findtext(path) or self.export.root.findtext(f"meta/{path}")
        return (found or "").strip()

    @property
    def name(self) -> str:
        """The name of the task, empty if the export does not give it."""
        return self.text("name")

    def named_frame(self, name: str, subset: str) -> CvatFrame:
        """Returns the frame that an image element names. Raises LabelError if its image is missing."""
        path, folder = path_in_labels(name), self.export.folder
        bases = self._base / _IMAGES, self._base, self._base / _IMAGES / path_in_labels(subset)
        number = frame_number(name)
        if number is None:
            with_suffix = path.suffix.lower() in IMAGE_SUFFIXES
            suffixes = ("",) if with_suffix else ("", *IMAGE_SUFFIXES)
            found = folder.find(*(base / path.with_name(path.name + suffix) for suffix in suffixes for base in bases))
            group = drive_of(found.parent) if len(path.parts) > 1 or not self.name else f"task {self.name}"
            return CvatFrame(ImageLocation(found), folder.name(found), group)
        frame = self._frame_of_video(number, [base / path for base in bases])
        if frame is not None:
            return frame
        raise LabelError(
            f"there is no file {_IMAGES}/{name}{IMAGE_SUFFIXES[0]}, and no video {self._video_name or 'of the task'}",
            "export the task with its images, or put its video next to the XML file",
        )

    def require_images(self) -> None:
        """Raises LabelError if it is not known where the images of numbered frames are."""
        if not self._is_of_images and self._video is None and not self._has_frame_images:
            raise LabelError(
                f"there is no file {self._video_name}, nor {_IMAGES}/frame_000000{IMAGE_SUFFIXES[0]}",
                "put the task's video next to the XML file, or export the task with its images",
            )
        if self._is_of_images:
            self._images_by_number  # noqa: B018 - raises it

    def numbered_frame(self, index: int) -> CvatFrame:
        """Returns the frame with a number of tracks. Raises LabelError if its image is missing."""
        folder, name = self.export.folder, f"frame_{index:06d}"
        if self._is_of_images:
            image = self._images_by_number.get(index)
            if image is None:
                raise LabelError(f"the task has no frame {index}", _NAME_IMAGES)
            return CvatFrame(ImageLocation(image), folder.name(image), f"task {self.name or self.export.path.stem}")
        frame = self._frame_of_video(index, [self._base / _IMAGES / name, self._base / name])
        if frame is None:
            raise LabelError(f"there is no file {_IMAGES}/{name}{IMAGE_SUFFIXES[0]}, nor {self._video_name}")
        return frame

    @property
    def _base(self) -> Path:
        return self.export.path.parent

    def _frame_of_video(self, index: int, stems: Sequence[Path]) -> CvatFrame | None:
        """Returns a frame of a video task: its image at one of `stems`, else in the video, else None."""
        folder, video = self.export.folder, self._video
        group = Path(self._video_name).stem if self.text("source") else f"task {self.name}"
        for stem in stems:
            try:
                image = folder.find_image(stem)
            except LabelError:
                continue
            return CvatFrame(ImageLocation(image), folder.name(image), group, video, index)
        if video is None:
            return None
        return CvatFrame(ImageLocation(video, index), f"{video.name}#{index}", video.stem, video, index)

    @property
    def _video_name(self) -> str:
        return self.text("source") or self.name or self.export.path.stem

    @cached_property
    def _video(self) -> Path | None:
        """The video of the task, next to its XML file or in the data set's folders for videos, if it is there."""
        try:
            return self.export.folder.find_video(path_in_labels(self._video_name), self.export.path)
        except LabelError:
            return None

    @cached_property
    def _is_of_images(self) -> bool:
        """Whether it is a task of images rather than of a video."""
        if self.text("source") or self.text("original_size/width"):
            return False
        mode = self.text("mode")
        return mode == "annotation" or (not mode and self._video is None and not self._has_frame_images)

    @property
    def _has_frame_images(self) -> bool:
        folders = self._base / _IMAGES, self._base
        return any(True for folder in folders for path in folder.glob("frame_*") if _FRAME_NAME.fullmatch(path.stem))

    @cached_property
    def _images_by_number(self) -> dict[int, Path]:
        """The images of a task of images by their numbers. Raises LabelError if these are not certain."""
        images, numbers = self._images, self._numbers
        if not images:
            raise LabelError(f"there are no images next to it or in its folder {_IMAGES}", "put them there")
        if numbers is not None and len(numbers) != len(images):
            raise LabelError(f"the task has {len(numbers)} frames, but there are {len(images)} images", _NAME_IMAGES)
        if images != sorted(images, key=_natural_key):
            unsure = "their order is not certain, because they are numbered without leading zeros"
            raise LabelError(f"the frames of the task are images, and {unsure}", _NAME_IMAGES)
        return dict(zip(range(len(images)) if numbers is None else numbers, images, strict=True))

    @cached_property
    def _images(self) -> list[Path]:
        """The images of the export, sorted by name as CVAT does."""
        folder = self._base / _IMAGES
        files = folder.rglob("*") if folder.is_dir() else self._base.iterdir()
        found = [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")]
        return sorted(found, key=Path.as_posix)

    @property
    def _numbers(self) -> range | None:
        """The numbers of the task's frames, if the export gives them."""
        size, start, stop = (self.text(name) for name in ("size", "start_frame", "stop_frame"))
        step = _STEP.search(self.text("frame_filter"))
        if start.isdecimal() and stop.isdecimal():
            return range(int(start), int(stop) + 1, max(int(step[1]), 1) if step else 1)
        return range(int(size)) if size.isdecimal() else None


def _natural_key(path: Path) -> list[str | int]:
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.as_posix())]
