"""What patches are varied by: seeded, each on its own, and never so that a label is no longer true."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from lanestream_exporter.samples.augment import augmented, photographed
from lanestream_exporter.training.config import Augmentation, Light

DARK = dict.fromkeys(Light.model_fields, 0.0)
STILL = Augmentation(flip=0.0, jitter=0.0, shear=0.0, light=Light(**DARK))


@pytest.fixture(scope="module")
def patches() -> NDArray[np.uint8]:
    """A white bar 16 pixels wide in the middle of grey asphalt, a red patch at the upper left."""
    patch = np.full((224, 224, 3), 90, np.uint8)
    patch += np.random.default_rng(0).integers(0, 8, patch.shape, dtype=np.uint8)
    patch[:, 104:120] = 220
    patch[:40, :40] = (200, 30, 30)
    return np.stack([patch] * 12)


def labels(value: int) -> NDArray[np.int64]:
    return np.full(12, value)


def centres(patch: NDArray[np.uint8]) -> NDArray[np.float64]:
    """The bar's column, row by row, below the red corner."""
    light = np.clip(patch[50:, 60:164].mean(axis=2) - 140.0, 0.0, None)
    return np.asarray((light * np.arange(60, 164)).sum(axis=1) / light.sum(axis=1))


def test_the_same_seed_gives_the_same_patches_and_each_its_own(patches: NDArray[np.uint8]) -> None:
    first, again, other = (augmented(patches, labels(1), Augmentation(), np.random.default_rng(s)) for s in (1, 1, 2))
    assert (first.shape, first.dtype) == (patches.shape, np.uint8)
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert len({patch.tobytes() for patch in first}) == len(first)


def test_nothing_happens_where_nothing_is_asked_for(patches: NDArray[np.uint8]) -> None:
    np.testing.assert_array_equal(augmented(patches, labels(0), STILL, np.random.default_rng(0)), patches)


def test_a_flip_mirrors(patches: NDArray[np.uint8]) -> None:
    always = STILL.model_copy(update={"flip": 1.0})
    np.testing.assert_array_equal(augmented(patches, labels(1), always, np.random.default_rng(0)), patches[:, :, ::-1])


def test_the_line_of_a_true_patch_stays_within_the_jitter(patches: NDArray[np.uint8]) -> None:
    shares = STILL.model_copy(update={"flip": 0.5, "jitter": 3.0 / 224.0, "shear": 1.0})
    moved = augmented(patches, labels(1), shares, np.random.default_rng(0))
    off = np.array([centres(patch) - 111.5 for patch in moved])
    assert np.abs(off).max() <= 3.1
    assert np.abs(off).max(axis=1).mean() > 1.0  # they do move
    tilts = np.abs(off[:, -1] - off[:, 0])
    assert tilts.max() > 1.0  # and turn


def test_shear_tilts_false_patches_alone(patches: NDArray[np.uint8]) -> None:
    shares = STILL.model_copy(update={"shear": 1.0})
    tilted = augmented(patches, labels(0), shares, np.random.default_rng(0))
    assert max(np.ptp(centres(patch)) for patch in tilted) > 20.0
    np.testing.assert_array_equal(augmented(patches, labels(1), shares, np.random.default_rng(0)), patches)


@pytest.mark.parametrize("accident", sorted(Light.model_fields))
def test_each_accident_of_light_changes_the_picture_and_moves_nothing(
    patches: NDArray[np.uint8], accident: str
) -> None:
    light = Light(**{**DARK, accident: 1.0})
    for seed in range(5):
        changed = photographed(patches[0], light, np.random.default_rng(seed))
        assert (changed != patches[0]).any()
        edges = [
            np.abs(cv2.Sobel(i.mean(axis=2)[60:, 90:134], cv2.CV_64F, 1, 0)).mean(axis=0) for i in (patches[0], changed)
        ]
        assert np.corrcoef(*edges)[0, 1] > 0.8  # the bar's edges are where they were


def test_accidents_do_what_they_are_called(patches: NDArray[np.uint8]) -> None:
    def mean(accident: str) -> NDArray[np.float64]:
        taken = [photographed(patches[0], Light(**{**DARK, accident: 1.0}), np.random.default_rng(s)) for s in range(8)]
        return np.asarray(np.mean(taken, axis=0).mean(axis=(1, 2)))

    plain = patches[0].mean(axis=(1, 2))
    assert mean("shadow").mean() < plain.mean()
    assert mean("glare").mean() > plain.mean()
    assert mean("lost").mean() < plain.mean()
    night = mean("night") / plain
    assert night[-1] > 2.0 * night[0]  # headlights reach the near road
    assert night.max() < 1.0
