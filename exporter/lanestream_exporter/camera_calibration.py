"""Calibrates a camera: its lens from pictures of a chessboard, its direction from a drive."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from lanestream.engine import Engine
from lanestream.errors import ImageError, SourceError
from lanestream.images.decoding import decode
from lanestream.protocol import CameraModel
from lanestream.road.view import Image
from lanestream.session import SessionOptions
from lanestream.tracking.calibration import FRAMES_NEEDED
from lanestream_exporter.datasets.files import natural_key
from lanestream_exporter.datasets.images import LIMITS, file_bytes

import cv2  # isort: skip  (lanestream.images sets OpenCV's own limit before it is imported)
import numpy as np  # isort: skip

_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".webp")
_USUAL_FPS: Final = 25.0
# Of a video, this many frames are searched for the board: enough views, in a minute or so.
_MOST_VIEWS: Final = 60
# Fewer views don't determine focal lengths, principal point and distortion.
_FEWEST_VIEWS: Final = 6


@dataclass(frozen=True)
class Picture:
    """A picture of a series, `timestamp` seconds after its start. `image` is None if it can't be read: `problem`."""

    name: str
    timestamp: float
    image: Image | None
    problem: str = ""


@dataclass(frozen=True)
class LensCalibration:
    """A lens in pixels of images of `size` (width, height), see `lanestream.road.camera.Camera`.

    `rms` is the reprojection error in pixels over the pictures `used`; `failed` says why others were not.
    """

    size: tuple[int, int]
    focal_length: tuple[float, float]
    principal_point: tuple[float, float]
    distortion: tuple[float, float, float, float, float]
    rms: float
    used: tuple[str, ...]
    failed: tuple[tuple[str, str], ...]

    def camera(self, height: float) -> CameraModel:
        """Returns the camera with this lens at a `height` in meters, rounded to what a calibration determines."""
        return CameraModel(
            height=height,
            focal_length=(round(self.focal_length[0], 2), round(self.focal_length[1], 2)),
            principal_point=(round(self.principal_point[0], 2), round(self.principal_point[1], 2)),
            image_size=self.size,
            distortion=tuple(round(value, 6) for value in self.distortion),  # type: ignore[arg-type]
        )


@dataclass(frozen=True)
class MountCalibration:
    """The direction of a camera: pitch and yaw in degrees with their sigmas, from `used` of `frames` frames."""

    pitch: float
    pitch_sigma: float
    yaw: float
    yaw_sigma: float
    used: int
    frames: int


def read_pictures(source: Path) -> Iterator[Picture]:
    """Yields the images of a folder in natural order, or the frames of a video.

    Raises SourceError if there are none.
    """
    if not source.exists():
        raise SourceError(f"no such file or folder: {source}", "give a folder of images or a video file")
    yield from _folder(source) if source.is_dir() else _video(source)


def views(source: Path) -> Iterator[Picture]:
    """Yields the pictures to search for a chessboard: all images of a folder, or some frames of a video."""
    if source.is_dir() or not source.exists():
        yield from read_pictures(source)
        return
    capture = cv2.VideoCapture(str(source))
    frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    capture.release()
    step = max(1, frames // _MOST_VIEWS)
    yield from (picture for number, picture in enumerate(read_pictures(source)) if number % step == 0)


def calibrate_lens(pictures: Iterable[Picture], board: tuple[int, int]) -> LensCalibration:
    """Returns the lens that took `pictures` of a flat chessboard with `board` inner corners (columns, rows).

    Corners are found by OpenCV's sector-based detector (A. Duda, U. Frese, "Accurate detection and localization of
    checkerboard corners for calibration", BMVC 2018); focal lengths, principal point and distortion minimize the
    reprojection error (Z. Zhang, "A flexible new technique for camera calibration", PAMI 2000). Only pictures of the
    most common size count. Raises SourceError if fewer than 6 of them show the whole board.
    """
    found: list[tuple[str, tuple[int, int], np.ndarray]] = []
    failed: list[tuple[str, str]] = []
    for picture in pictures:
        if picture.image is None:
            failed.append((picture.name, picture.problem))
            continue
        gray = cv2.cvtColor(picture.image, cv2.COLOR_BGR2GRAY)
        success, corners = cv2.findChessboardCornersSB(gray, board, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if success:
            found.append((picture.name, (gray.shape[1], gray.shape[0]), corners))
        else:
            failed.append((picture.name, "no whole chessboard"))
    across, down = board
    if not found:
        raise SourceError(
            f"no chessboard of {across}x{down} inner corners was found in {len(failed)} pictures",
            "give its number of inner corners with --board, and pictures that show all of it",
        )
    size, _ = Counter(size for _, size, _ in found).most_common(1)[0]
    failed += [(name, f"{w} x {h}, not {size[0]} x {size[1]}") for name, (w, h), _ in found if (w, h) != size]
    used = [(name, corners) for name, of_size, corners in found if of_size == size]
    if len(used) < _FEWEST_VIEWS:
        raise SourceError(
            f"the chessboard was found in {len(used)} pictures of the same size; {_FEWEST_VIEWS} are needed",
            "take 10 to 20 pictures of it, from different sides and in all corners of the image",
        )
    points = np.zeros((across * down, 3), np.float32)
    points[:, :2] = np.mgrid[:across, :down].T.reshape(-1, 2)
    rms, matrix, distortion, _, _ = cv2.calibrateCamera(
        [points] * len(used), [corners for _, corners in used], size, np.eye(3), np.zeros(5)
    )
    k1, k2, p1, p2, k3 = distortion.ravel()[:5].tolist()
    return LensCalibration(
        size=size,
        focal_length=(float(matrix[0, 0]), float(matrix[1, 1])),
        principal_point=(float(matrix[0, 2]), float(matrix[1, 2])),
        distortion=(k1, k2, p1, p2, k3),
        rms=float(rms),
        used=tuple(name for name, _ in used),
        failed=tuple(failed),
    )


def calibrate_mount(pictures: Iterable[Picture], camera: CameraModel, engine: Engine) -> MountCalibration:
    """Returns the direction of a `camera` whose vehicle drives along mostly straight roads.

    Runs the tracker with pitch and yaw to be estimated; what the camera says about them is not used. Raises SourceError
    if a picture can't be read, or if too few frames show a straight road.
    """
    estimated = camera.model_copy(update={"pitch": "auto", "yaw": "auto"})
    session = engine.open_session(SessionOptions.of(None, None, estimated))
    frames, calibration = 0, None
    for picture in pictures:
        if picture.image is None:
            raise SourceError(f"{picture.name}: {picture.problem}")
        calibration = engine.process(session, picture.image, picture.timestamp).calibration
        frames += 1
    used = session.state.calibration.used
    if calibration is None or not calibration.settled:
        raise SourceError(
            f"the direction is not known: {used} of {frames} frames show a straight road; {FRAMES_NEEDED} are needed",
            "give a longer drive, on straight roads with markings",
        )
    pitch, yaw = calibration.pitch, calibration.yaw
    return MountCalibration(pitch.value, pitch.sigma, yaw.value, yaw.sigma, used, frames)


def _folder(folder: Path) -> Iterator[Picture]:
    files = sorted(
        (path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES), key=lambda path: natural_key(path.name)
    )
    if not files:
        raise SourceError(f"no images in the folder {folder}", f"accepted file types: {', '.join(_SUFFIXES)}")
    for number, path in enumerate(files):
        picture = Picture(path.name, number / _USUAL_FPS, None)
        try:
            yield replace(picture, image=decode(file_bytes(path), LIMITS))
        except ImageError as error:
            yield replace(picture, problem=error.message)


def _video(video: Path) -> Iterator[Picture]:
    capture = cv2.VideoCapture(str(video))
    try:
        fps = capture.get(cv2.CAP_PROP_FPS) or _USUAL_FPS
        number = 0
        while capture.isOpened():
            decoded, image = capture.read()
            if not decoded:
                break
            yield Picture(f"frame {number}", number / fps, np.asarray(image, np.uint8))
            number += 1
        if number == 0:
            raise SourceError(f"{video} can't be read as a video", "give a folder of images or a video file")
    finally:
        capture.release()
