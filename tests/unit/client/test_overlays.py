"""Drawing lanes and errors on images."""

from __future__ import annotations

import fakes
import numpy as np
import pytest

from lanestream.errors import SourceError
from lanestream.local import LocalEngine
from lanestream.protocol import LanesMessage, error_message
from lanestream.road.view import Image
from lanestream_client.overlays import draw_error, draw_lanes


def road(width: int, height: int) -> tuple[Image, LanesMessage]:
    image = np.full((height, width, 3), 90, np.uint8)
    return image, LocalEngine(fakes.engine()).open_camera().lanes(image, seq=7, timestamp=0.0)


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (320, 180), (64, 64), (3840, 2160), (181, 101)])
def test_lanes_are_drawn_at_any_size(width: int, height: int) -> None:
    image, message = road(width, height)
    drawn = draw_lanes(image, message)
    assert drawn.shape == image.shape
    assert drawn.dtype == np.uint8
    assert (image == 90).all(), "the original is unchanged"
    left, right = message.lanes
    row = round(0.8 * height)
    blue, _, red = (int(value) for value in drawn[row, round(left.x(row))])
    assert red > blue, "the left boundary is orange"
    blue, _, red = (int(value) for value in drawn[row, round(right.x(row))])
    assert blue > red, "the right boundary is blue"
    middle = drawn[row, width // 2]
    assert middle[1] > middle[2], "the ego lane is green"


def test_predicted_boundaries_are_dashed() -> None:
    image, message = road(1280, 720)

    def drawn_pixels(state: str) -> int:
        lane = message.lanes[0].model_copy(update={"state": state, "position": -2})
        drawn = draw_lanes(image, message.model_copy(update={"lanes": [lane]}))
        return int((drawn[360:] != 90).any(axis=2).sum())

    assert drawn_pixels("predicted") < 0.75 * drawn_pixels("detected")


def test_no_lanes_and_unknown_positions_can_be_drawn() -> None:
    image, message = road(320, 180)
    assert draw_lanes(image, message.model_copy(update={"lanes": []})).shape == image.shape
    outer = message.lanes[0].model_copy(update={"position": 5})
    assert draw_lanes(image, message.model_copy(update={"lanes": [outer]})).shape == image.shape


def test_an_error_can_be_drawn() -> None:
    image = np.full((180, 320, 3), 90, np.uint8)
    assert (draw_error(image, error_message(SourceError("why"), seq=3)) != image).any()
