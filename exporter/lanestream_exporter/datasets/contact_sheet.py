"""Draws a contact sheet: thumbnails of labeled frames with their lanes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.errors import SourceError
from lanestream.road.curve import FloatArray
from lanestream.road.view import Image
from lanestream.writing import check_file, writing
from lanestream_exporter.datasets.labels import LabeledFrame

_COLUMNS: Final = 6
_WIDTH: Final = 320  # pixels of a thumbnail
_CAPTION: Final = 18  # pixels of height
_MOST: Final = 60  # thumbnails
_DOT_DISTANCE: Final = 8.0  # pixels between the dots along an edge of the road
_SUBPIXEL_BITS: Final = 4
_SUFFIXES: Final = (".jpg", ".jpeg", ".png")

# Colors are blue, green, red.
_POSITIONS: Final[Mapping[int, tuple[int, int, int]]] = {
    -2: (200, 120, 220),
    -1: (40, 170, 255),
    1: (255, 190, 70),
    2: (110, 230, 240),
}
# Colors of lanes without a position, in order.
_PALETTE: Final = ((60, 220, 60), (60, 60, 255), (255, 200, 40), (240, 60, 240), (60, 220, 255))


class ContactSheet:
    """Keeps up to 60 of the added frames, evenly spread over all of them."""

    def __init__(self, path: Path) -> None:
        """Starts a sheet to be written to `path`. Raises SourceError if no image can be written there."""
        if path.suffix.lower() not in _SUFFIXES:
            raise SourceError(
                f"can't write an image to {path}", f"a path that ends in {' or '.join(_SUFFIXES)} is accepted"
            )
        check_file(path)
        self._path = path
        self._tiles: list[Image] = []
        self._stride = 1
        self._seen = 0

    def __len__(self) -> int:
        return len(self._chosen())

    def add(self, frame: LabeledFrame, image: Image) -> None:
        """Adds a frame, or skips it to keep the sheet evenly spread."""
        if self._seen % self._stride == 0:
            self._tiles.append(_tile(frame, image))
        self._seen += 1
        if len(self._tiles) >= 2 * _MOST:
            self._tiles = self._tiles[::2]
            self._stride *= 2

    def write(self) -> None:
        """Writes the sheet. Raises SourceError if it can't be written."""
        data = cv2.imencode(self._path.suffix.lower(), self._page())[1].tobytes()
        with writing(self._path):
            self._path.write_bytes(data)

    def _chosen(self) -> list[Image]:
        count = min(_MOST, len(self._tiles))
        return [self._tiles[number] for number in np.linspace(0, len(self._tiles) - 1, count).round().astype(int)]

    def _page(self) -> Image:
        tiles = self._chosen()
        columns = min(_COLUMNS, len(tiles))
        height = max(tile.shape[0] for tile in tiles)
        page = np.zeros((-(-len(tiles) // columns) * height, columns * _WIDTH, 3), np.uint8)
        for number, tile in enumerate(tiles):
            top, left = number // columns * height, number % columns * _WIDTH
            page[top : top + tile.shape[0], left : left + _WIDTH] = tile
        return page


def _tile(frame: LabeledFrame, image: Image) -> Image:
    """Returns the thumbnail of a frame with its lanes, edges of the road dotted, and its name underneath."""
    scale = _WIDTH / frame.width
    thumbnail = cv2.resize(image, (_WIDTH, max(1, round(frame.height * scale))), interpolation=cv2.INTER_AREA)
    for number, lane in enumerate(frame.lanes):
        color = _POSITIONS.get(lane.position or 0, _PALETTE[number % len(_PALETTE)])
        points = (lane.points + 0.5) * scale - 0.5
        if lane.kind == "road_edge":
            for dot in _every(_DOT_DISTANCE, points):
                cv2.circle(thumbnail, _fixed(dot).tolist(), 2 << _SUBPIXEL_BITS, color, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
        else:
            cv2.polylines(thumbnail, [_fixed(points)], False, color, 2, cv2.LINE_AA, _SUBPIXEL_BITS)
    caption = np.zeros((_CAPTION, _WIDTH, 3), np.uint8)
    name = frame.source.encode("ascii", "replace").decode()[-52:]
    cv2.putText(caption, name, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (220, 220, 220), 1, cv2.LINE_AA)
    return np.vstack([thumbnail, caption]).astype(np.uint8, copy=False)


def _every(distance: float, points: FloatArray) -> FloatArray:
    """Returns points (M, 2) at even distances along the polyline `points` (N, 2), about `distance` apart."""
    lengths = np.concatenate([[0.0], np.hypot(*np.diff(points, axis=0).T).cumsum()])
    along = np.linspace(0.0, lengths[-1], max(2, round(lengths[-1] / distance) + 1))
    return np.stack([np.interp(along, lengths, column) for column in points.T], axis=1)


def _fixed(points: FloatArray) -> NDArray[np.int32]:
    """Returns points in OpenCV's fixed-point format."""
    return np.round(points * (1 << _SUBPIXEL_BITS)).astype(np.int32)
