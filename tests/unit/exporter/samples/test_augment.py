"""Augmentation is seeded, varies every patch on its own, and keeps its boundary."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from lanestream_exporter.samples.augment import Augmentation, Corruptions, augmented, corrupted

NONE = dict.fromkeys(Corruptions.model_fields, 0.0)
UNCHANGED = Augmentation(flip=0.0, jitter=0.0, shear=0.0, corruptions=Corruptions(**NONE))


@pytest.fixture(scope="module")
def patches() -> NDArray[np.uint8]:
    """A white bar 16 pixels wide in the middle of gray asphalt, and a red square at the top left."""
    patch = np.full((224, 224, 3), 90, np.uint8)
    patch += np.random.default_rng(0).integers(0, 8, patch.shape, dtype=np.uint8)
    patch[:, 104:120] = 220
    patch[:40, :40] = (200, 30, 30)
    return np.stack([patch] * 12)


def all_are(is_boundary: bool) -> NDArray[np.bool_]:
    """Returns that all patches show a boundary, or none."""
    return np.full(12, is_boundary)


def centers(patch: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Returns the bar's column, row by row, below the red corner."""
    brightness = np.clip(patch[50:, 60:164].mean(axis=2) - 140.0, 0.0, None)
    return np.asarray((brightness * np.arange(60, 164)).sum(axis=1) / brightness.sum(axis=1))


def test_the_same_seed_gives_the_same_patches_and_each_its_own(patches: NDArray[np.uint8]) -> None:
    first, again, other = (
        augmented(patches, all_are(True), Augmentation(), np.random.default_rng(s)) for s in (1, 1, 2)
    )
    assert (first.shape, first.dtype) == (patches.shape, np.uint8)
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert len({patch.tobytes() for patch in first}) == len(first)


def test_shares_of_zero_change_nothing(patches: NDArray[np.uint8]) -> None:
    np.testing.assert_array_equal(augmented(patches, all_are(False), UNCHANGED, np.random.default_rng(0)), patches)


def test_a_flip_mirrors(patches: NDArray[np.uint8]) -> None:
    always = UNCHANGED.model_copy(update={"flip": 1.0})
    np.testing.assert_array_equal(
        augmented(patches, all_are(True), always, np.random.default_rng(0)), patches[:, :, ::-1]
    )


def test_the_line_of_a_boundary_stays_within_the_jitter(patches: NDArray[np.uint8]) -> None:
    shares = UNCHANGED.model_copy(update={"flip": 0.5, "jitter": 3.0 / 224.0, "shear": 1.0})
    moved = augmented(patches, all_are(True), shares, np.random.default_rng(0))
    off = np.array([centers(patch) - 111.5 for patch in moved])
    assert np.abs(off).max() <= 3.1
    assert np.abs(off).max(axis=1).mean() > 1.0  # they do move
    tilts = np.abs(off[:, -1] - off[:, 0])
    assert tilts.max() > 1.0  # and tilt


def test_shear_tilts_patches_without_a_boundary_alone(patches: NDArray[np.uint8]) -> None:
    shares = UNCHANGED.model_copy(update={"shear": 1.0})
    tilted = augmented(patches, all_are(False), shares, np.random.default_rng(0))
    assert max(np.ptp(centers(patch)) for patch in tilted) > 20.0
    np.testing.assert_array_equal(augmented(patches, all_are(True), shares, np.random.default_rng(0)), patches)


@pytest.mark.parametrize("corruption", sorted(Corruptions.model_fields))
def test_each_corruption_changes_the_image_and_moves_nothing(patches: NDArray[np.uint8], corruption: str) -> None:
    shares = Corruptions(**{**NONE, corruption: 1.0})
    for seed in range(5):
        changed = corrupted(patches[0], shares, np.random.default_rng(seed))
        assert (changed != patches[0]).any()
        edges = [
            np.abs(cv2.Sobel(i.mean(axis=2)[60:, 90:134], cv2.CV_64F, 1, 0)).mean(axis=0) for i in (patches[0], changed)
        ]
        assert np.corrcoef(*edges)[0, 1] > 0.8  # the bar's edges are where they were


def test_corruptions_do_what_their_names_say(patches: NDArray[np.uint8]) -> None:
    def mean(corruption: str) -> NDArray[np.float64]:
        results = [
            corrupted(patches[0], Corruptions(**{**NONE, corruption: 1.0}), np.random.default_rng(s)) for s in range(8)
        ]
        return np.asarray(np.mean(results, axis=0).mean(axis=(1, 2)))

    plain = patches[0].mean(axis=(1, 2))
    assert mean("shadow").mean() < plain.mean()
    assert mean("glare").mean() > plain.mean()
    assert mean("lost").mean() < plain.mean()
    night = mean("night") / plain
    assert night[-1] > 2.0 * night[0]  # headlights reach the near road
    assert night.max() < 1.0
