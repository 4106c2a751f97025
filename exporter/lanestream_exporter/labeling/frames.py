"""The frames to label: image files one by one, or a video at even distances through the tracker."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import cv2

from lanestream.engine import Engine
from lanestream.errors import LanestreamError, SourceError
from lanestream.images.decoding import decode
from lanestream.road.view import Image
from lanestream.session import SessionOptions
from lanestream_exporter.datasets.files import IMAGE_SUFFIXES, natural_key
from lanestream_exporter.datasets.images import LIMITS, decoded_frames, file_bytes
from lanestream_exporter.labeling.difficulty import DetectorComparison
from lanestream_exporter.labeling.prelabels import PrelabeledFrame, prelabels

_JPEG_QUALITY: Final = 95


class Labeler:
    """Labels frames with the networks of an engine."""

    def __init__(self, engine: Engine) -> None:
        """Raises ModelError if the engine lacks one of the two detectors."""
        self._engine = engine
        self._comparison = DetectorComparison(engine)

    def images(self, paths: Sequence[Path], skipped: Callable[[LanestreamError], None]) -> Iterator[PrelabeledFrame]:
        """Yields the frames of image files, each on its own. `skipped` is called for those that can't be decoded."""
        for path in paths:
            try:
                image = decode(file_bytes(path), LIMITS)
            except LanestreamError as error:
                skipped(SourceError(f"{path}: {error.message}", error.hint))
                continue
            session = self._engine.open_session(SessionOptions(single_image=True))
            height, width = image.shape[:2]
            lanes = prelabels(self._engine.process(session, image, 0.0), width, height, with_ids=False)
            yield PrelabeledFrame(path, path.name, path.stem, width, height, lanes, self._comparison.difficulty(image))

    def video(self, path: Path, seconds: float, folder: Path) -> Iterator[PrelabeledFrame]:
        """Yields a frame of a video every so many `seconds`, and writes its image to `folder`.

        All frames between go through the tracker, too. Raises SourceError if the video can't be read.
        """
        session = self._engine.open_session()
        due = 0.0
        for index, image, timestamp in decoded_frames(path):
            result = self._engine.process(session, image, timestamp)
            if timestamp < due:
                continue
            due += seconds
            height, width = image.shape[:2]
            lanes = prelabels(result, width, height, with_ids=True)
            stem = f"{path.stem}_{index:06d}"
            written = _written(image, folder / f"{stem}.jpg")
            difficulty = self._comparison.difficulty(image)
            yield PrelabeledFrame(written, f"{path.name}#{index}", stem, width, height, lanes, difficulty)


def image_paths(inputs: Sequence[Path]) -> list[Path] | None:
    """Returns the image files among `inputs`: those in a folder in natural order, or the files themselves.

    Returns None for a single file of another kind, which may be a video. Raises SourceError for anything else.
    """
    if len(inputs) == 1 and inputs[0].is_dir():
        files = [path for path in inputs[0].iterdir() if _is_image(path) and not path.name.startswith(".")]
        if not files:
            raise SourceError(
                f"no images in the folder {inputs[0]}", f"accepted file types: {', '.join(IMAGE_SUFFIXES)}"
            )
        return sorted(files, key=lambda path: natural_key(path.name))
    for path in inputs:
        if not path.exists():
            raise SourceError(f"no such file or folder: {path}", "give a folder of images, image files or a video")
    if all(map(_is_image, inputs)):
        return list(inputs)
    if len(inputs) == 1:
        return None
    other = next(path for path in inputs if not _is_image(path))
    raise SourceError(
        f"{other} is not an image, but one of several inputs", "give a folder of images, image files or a video"
    )


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()


def _written(image: Image, path: Path) -> Path:
    path.write_bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes())
    return path
