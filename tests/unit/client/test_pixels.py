"""Which arrays are frames, and how they become JPEG files."""

from __future__ import annotations

from typing import Any

import cv2
import fakes
import numpy as np
import pytest

from lanestream.errors import ImageError
from lanestream_client.frames import SourceFrame
from lanestream_client.pixels import check_pixels, encode_jpeg


@pytest.mark.parametrize(
    ("pixels", "reason"),
    [
        (np.zeros((4, 4, 3), np.float32), "the type float32 and the shape (4, 4, 3)"),
        (np.zeros((4, 4), np.uint8), "the shape (4, 4)"),
        (np.zeros((4, 4, 4), np.uint8), "the shape (4, 4, 4)"),
        (np.zeros((3, 4, 4), np.uint8), "the shape (3, 4, 4)"),
        (np.zeros((0, 4, 3), np.uint8), "the shape (0, 4, 3)"),
        ([[[1, 2, 3]]], "the frame is of type list, not a NumPy array"),
        ("road.jpg", "the frame is of type str, not a NumPy array"),
    ],
)
def test_other_arrays_are_refused_with_what_is_accepted(pixels: Any, reason: str) -> None:
    with pytest.raises(ImageError) as caught:
        SourceFrame(0, None, pixels=pixels)
    assert reason in caught.value.message
    assert "uint8 pixels of shape (H, W, 3)" in caught.value.hint


def test_pixels_must_have_the_size_of_their_lanes() -> None:
    check_pixels(fakes.picture(), (320, 180))
    with pytest.raises(ImageError, match="320 x 180, but its lanes are in pixels of 180 x 320"):
        check_pixels(fakes.picture(), (180, 320))


def test_colors_are_blue_green_red() -> None:
    pixels = np.full((40, 40, 3), (200, 20, 60), np.uint8)
    for image in (pixels, pixels[:, ::-1], np.ascontiguousarray(pixels[..., ::-1])[..., ::-1]):
        decoded = cv2.imdecode(np.frombuffer(encode_jpeg(image, 90), np.uint8), cv2.IMREAD_COLOR)
        assert np.abs(decoded.astype(int) - (200, 20, 60)).max() < 8


def test_an_image_that_no_jpeg_holds_is_refused() -> None:
    with pytest.raises(ImageError, match="65536 x 1, too large for a JPEG"):
        encode_jpeg(np.zeros((1, 65536, 3), np.uint8), 90)
