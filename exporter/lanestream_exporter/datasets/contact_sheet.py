"""A contact sheet: small pictures of labelled frames with their lanes drawn on, to look through at a glance."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from lanestream.errors import SourceError
from lanestream.road.view import Image
from lanestream_exporter.datasets.labels import LabelledFrame

_COLUMNS: Final = 6
_WIDTH: Final = 320  # pixels of a small picture
_CAPTION: Final = 18  # pixels of height
_MOST: Final = 60
_SUBPIXEL_BITS: Final = 4
_KINDS: Final = (".jpg", ".jpeg", ".png")

Colour = tuple[int, int, int]  # blue, green, red

_POSITIONS: Final[Mapping[int, Colour]] = {
    -2: (200, 120, 220),
    -1: (40, 170, 255),
    1: (255, 190, 70),
    2: (110, 230, 240),
}
# Where nobody told positions, neighbours are told apart.
_IN_TURN: Final[tuple[Colour, ...]] = ((60, 220, 60), (60, 60, 255), (255, 200, 40), (240, 60, 240), (60, 220, 255))


class ContactSheet:
    """Keeps up to 60 of the frames that are added, evenly spread over all of them."""

    def __init__(self, path: Path) -> None:
        """Will be written to `path`. Raises SourceError where its suffix is of no kind of picture."""
        if path.suffix.lower() not in _KINDS:
            raise SourceError(
                f"can't write a picture to {path}", f"a path that ends in {' or '.join(_KINDS)} is accepted"
            )
        self._path = path
        self._tiles: list[Image] = []
        self._stride = 1
        self._seen = 0

    def __len__(self) -> int:
        return len(self._chosen())

    def add(self, frame: LabelledFrame, image: Image) -> None:
        """Takes a frame, or passes it over."""
        if self._seen % self._stride == 0:
            self._tiles.append(_tile(frame, image))
        self._seen += 1
        if len(self._tiles) >= 2 * _MOST:
            self._tiles = self._tiles[::2]
            self._stride *= 2

    def write(self) -> None:
        """Writes the sheet. Raises SourceError where that can't be done."""
        data = cv2.imencode(self._path.suffix.lower(), self._page())[1].tobytes()
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.write_bytes(data)
        except OSError as error:
            raise SourceError(f"can't write {self._path}: {(error.strerror or str(error)).lower()}") from None

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


def _tile(frame: LabelledFrame, image: Image) -> Image:
    """A frame at its small size with its lanes, and its name below."""
    scale = _WIDTH / frame.width
    picture = cv2.resize(image, (_WIDTH, max(1, round(frame.height * scale))), interpolation=cv2.INTER_AREA)
    for number, lane in enumerate(frame.lanes):
        colour = _POSITIONS.get(lane.position or 0, _IN_TURN[number % len(_IN_TURN)])
        fixed = np.round(((lane.points + 0.5) * scale - 0.5) * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        cv2.polylines(picture, [fixed], False, colour, 2, cv2.LINE_AA, _SUBPIXEL_BITS)
    caption = np.zeros((_CAPTION, _WIDTH, 3), np.uint8)
    name = frame.source.encode("ascii", "replace").decode()[-52:]
    cv2.putText(caption, name, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (220, 220, 220), 1, cv2.LINE_AA)
    return np.vstack([picture, caption]).astype(np.uint8, copy=False)
