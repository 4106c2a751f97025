"""Cuts between textured pictures, and pictures that change without one."""

from __future__ import annotations

from base64 import b64encode

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from lanestream.images.scene_cut import _LONGEST_S, SceneMemory
from lanestream.road.view import Image

DT = 0.04


def scene(seed: int, columns: float = 0.0, rows: float = 0.0) -> Image:
    """Returns a picture with large and small structures, seen from a camera that has turned by some pixels."""
    rng = np.random.default_rng(seed)
    levels: NDArray[np.float64] = np.zeros((360, 640))
    for size in (9, 18, 36, 90):
        levels += cv2.resize(rng.normal(0.0, 18.0, (size, size * 16 // 9)), (640, 360), interpolation=cv2.INTER_CUBIC)
    # What all roads share: the sky is bright, and the ground gets darker towards the camera.
    levels += np.linspace(190.0, 70.0, 360)[:, None]
    moved = cv2.warpAffine(
        levels, np.array([[1.0, 0.0, columns], [0.0, 1.0, rows]]), (640, 360), borderMode=cv2.BORDER_REFLECT
    )
    return np.repeat(moved.clip(0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


def cuts(images: list[Image], seconds: float = DT) -> list[int]:
    """Returns the numbers of the frames that show another scene than the one before."""
    memory, found = SceneMemory(), []
    for number, image in enumerate(images):
        memory, is_cut = memory.next(image, seconds)
        memory.validate()
        if is_cut:
            found.append(number)
    return found


@pytest.mark.parametrize("seed", range(8))
def test_a_cut_between_two_scenes_is_found_at_once(seed: int) -> None:
    one = [scene(seed, columns=2.0 * i) for i in range(6)]
    other = [scene(100 + seed, columns=2.0 * i) for i in range(6)]
    assert cuts(one + other) == [6]
    assert cuts(one + other + one) == [6, 12]


@pytest.mark.parametrize("seed", range(8))
def test_small_motion_is_not_a_cut(seed: int) -> None:
    assert cuts([scene(seed, columns=6.0 * i, rows=4.0 * (-1) ** i) for i in range(12)]) == []


@pytest.mark.parametrize("sigma", [5.0, 25.0])
def test_noise_is_not_a_cut(sigma: float) -> None:
    rng = np.random.default_rng(1)
    clear = scene(3).astype(float)
    noisy = [(clear + rng.normal(0.0, sigma, clear.shape)).clip(0, 255).astype(np.uint8) for _ in range(12)]
    assert cuts(noisy) == []


def test_a_change_of_brightness_is_not_a_cut() -> None:
    picture = scene(4)
    assert cuts([picture, picture, (0.6 * picture).astype(np.uint8), picture]) == []


def test_pictures_without_structure_are_not_cuts() -> None:
    """Fog, a covered lens, or a tunnel: their noise must not decide."""
    rng = np.random.default_rng(2)
    flat = [np.full((360, 640, 3), shade, np.uint8) for shade in (0, 0, 90, 255, 90)]
    assert cuts(flat) == []
    foggy = [rng.normal(120.0, 4.0, (360, 640, 3)).clip(0, 255).astype(np.uint8) for _ in range(12)]
    assert cuts(foggy) == []


def test_frames_too_far_apart_are_not_compared() -> None:
    images = [scene(5), scene(6), scene(7)]
    assert cuts(images, _LONGEST_S) == [1, 2]
    assert cuts(images, _LONGEST_S + 0.01) == []


def test_after_a_gap_the_next_frames_are_compared_again() -> None:
    memory, _ = SceneMemory().next(scene(5), DT)
    memory, is_cut = memory.next(scene(6), 10.0)
    assert not is_cut
    memory, is_cut = memory.next(scene(6, columns=2.0), DT)
    assert not is_cut
    assert memory.next(scene(5), DT)[1]


def test_a_change_of_a_part_of_the_picture_is_not_a_cut() -> None:
    """A bridge passes overhead, or a truck covers one side."""
    first, last = scene(1), scene(2)
    top, side = first.copy(), first.copy()
    top[:120], side[:, :250] = last[:120], last[:, :250]
    assert cuts([first, top, first, side, first]) == []


def test_frames_farther_apart_may_be_less_similar() -> None:
    images = [scene(3, columns=30.0 * i) for i in range(6)]
    assert cuts(images, 0.02) != []
    assert cuts(images, _LONGEST_S) == []


@pytest.mark.parametrize("size", [(16, 9), (33, 47), (1920, 1080)])
def test_images_of_any_size_are_remembered_in_a_few_bytes(size: tuple[int, int]) -> None:
    memory, is_cut = SceneMemory().next(cv2.resize(scene(8), size), DT)
    assert not is_cut
    assert len(memory.thumbnail) < 300
    memory.validate()
    assert not memory.next(cv2.resize(scene(8), (640, 360)), DT)[1]


def test_a_memory_from_elsewhere_is_checked() -> None:
    memory, _ = SceneMemory().next(scene(9), DT)
    SceneMemory().validate()
    for wrong, reason in (
        (SceneMemory(thumbnail="!"), "not valid base 64"),
        (SceneMemory(thumbnail=memory.thumbnail[:-4]), "has 141 bytes; expected 144"),
        (SceneMemory(thumbnail=b64encode(bytes(145)).decode()), "has 145 bytes; expected 144"),
    ):
        with pytest.raises(ValueError, match=reason) as error:
            wrong.validate()
        assert "\n" not in str(error.value)
