"""Random choices that come back as plain Python values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

T = TypeVar("T")


@dataclass(frozen=True)
class RandomSampler:
    """A random generator with the few kinds of choice that sampling a scene needs."""

    rng: np.random.Generator

    def between(self, low: float, high: float) -> float:
        """A uniform number from low to high."""
        return float(self.rng.uniform(low, high))

    def around(self, deviation: float, limit: float = 2.5) -> float:
        """A normal number about zero, cut at `limit` deviations."""
        return float(np.clip(self.rng.normal(0.0, 1.0), -limit, limit)) * deviation

    def whole(self, low: int, high: int) -> int:
        """A whole number from low to high, both included."""
        return int(self.rng.integers(low, high + 1))

    def chance(self, share: float) -> bool:
        """True in this share of cases."""
        return bool(self.rng.random() < share)

    def pick(self, options: Sequence[T]) -> T:
        """One of the options, each as likely."""
        return options[int(self.rng.integers(len(options)))]

    def weighed(self, options: Mapping[T, float]) -> T:
        """One of the keys, as likely as its weight says."""
        weights = np.array(list(options.values()))
        keys: list[T] = list(options)
        return keys[int(self.rng.choice(len(weights), p=weights / weights.sum()))]

    def seed(self) -> int:
        """A seed for something drawn later."""
        return int(self.rng.integers(2**31))
