"""Pictures without a road: many kinds, any size, the same for the same seed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from lanestream_exporter.scenes import sample_picture
from lanestream_exporter.scenes.no_road import KINDS
from lanestream_exporter.scenes.random_sampler import RandomSampler

if TYPE_CHECKING:
    from numpy.typing import NDArray

SIZES = [(64, 64), (640, 360), (1280, 720), (90, 160), (101, 67), (300, 64)]


def picture(seed: int, width: int = 160, height: int = 90) -> NDArray[np.uint8]:
    return sample_picture(np.random.default_rng(seed), width, height)


def drawn(kind: str, seed: int, width: int, height: int) -> NDArray[np.uint8]:
    """Returns a picture of one kind, as it is before the lens."""
    return KINDS[kind].draw(RandomSampler(np.random.default_rng(seed)), np.zeros((height, width, 3), np.uint8))


@pytest.fixture(scope="module")
def pictures() -> list[NDArray[np.uint8]]:
    return [picture(seed) for seed in range(60)]


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_a_picture_has_the_size_that_was_asked_for(width: int, height: int) -> None:
    for seed in range(4):
        image = picture(seed, width, height)
        assert image.shape == (height, width, 3)
        assert image.dtype == np.uint8


def test_the_same_seed_gives_the_same_picture_and_the_next_picture_is_another() -> None:
    first, second = np.random.default_rng(3), np.random.default_rng(3)
    for _ in range(12):
        np.testing.assert_array_equal(sample_picture(first, 160, 90), sample_picture(second, 160, 90))
    assert np.any(sample_picture(first, 160, 90) != picture(3))


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_can_be_drawn_at_every_size_and_varies(kind: str) -> None:
    for width, height in ((64, 64), (90, 160), (320, 180)):
        images = [drawn(kind, seed, width, height) for seed in range(5)]
        assert {(image.shape, image.dtype) for image in images} == {((height, width, 3), np.dtype(np.uint8))}
        assert len({image.tobytes() for image in images}) == 5


def test_pictures_differ_in_light_color_and_detail(pictures: list[NDArray[np.uint8]]) -> None:
    grays = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in pictures]
    brightness = [gray.mean() for gray in grays]
    detail = [np.abs(cv2.Laplacian(gray, cv2.CV_32F)).mean() for gray in grays]
    color = [np.ptp(image.reshape(-1, 3).mean(axis=0)) for image in pictures]
    assert np.quantile(brightness, 0.9) - np.quantile(brightness, 0.1) > 80.0
    assert np.quantile(detail, 0.9) > 4.0 * np.quantile(detail, 0.1)
    assert np.quantile(color, 0.1) < 10.0 < 30.0 < np.quantile(color, 0.9)


def test_most_pictures_show_straight_edges_as_lane_lines_do(pictures: list[NDArray[np.uint8]]) -> None:
    found = [cv2.HoughLinesP(cv2.Canny(image, 60, 150), 1, np.pi / 180, 30, None, 30, 3) for image in pictures]
    assert sum(lines is not None for lines in found) > len(pictures) / 2


def test_every_kind_has_its_share() -> None:
    assert len(KINDS) >= 20
    assert sum(kind.share for kind in KINDS.values()) == pytest.approx(1.0)
    assert min(kind.share for kind in KINDS.values()) >= 0.02
