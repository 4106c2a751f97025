"""Random choices that return plain Python values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

T = TypeVar("T")


@dataclass(frozen=True)
class RandomSampler:
    """Wraps a random generator with the distributions that scene sampling needs."""

    rng: np.random.Generator

    def uniform(self, low: float, high: float) -> float:
        """Returns a number drawn uniformly from [low, high)."""
        return float(self.rng.uniform(low, high))

    def normal(self, sigma: float, limit: float = 2.5) -> float:
        """Returns a zero-mean normal number, clipped at `limit` sigmas."""
        return float(np.clip(self.rng.normal(0.0, 1.0), -limit, limit)) * sigma

    def integer(self, low: int, high: int) -> int:
        """Returns an integer drawn uniformly from low to high, both included."""
        return int(self.rng.integers(low, high + 1))

    def bernoulli(self, probability: float) -> bool:
        """Returns True with the given probability."""
        return bool(self.rng.random() < probability)

    def choice(self, options: Sequence[T]) -> T:
        """Returns one of the options, all equally likely."""
        return options[int(self.rng.integers(len(options)))]

    def weighted_choice(self, options: Mapping[T, float]) -> T:
        """Returns one of the keys, with a probability proportional to its weight."""
        weights = np.array(list(options.values()))
        keys: list[T] = list(options)
        return keys[int(self.rng.choice(len(weights), p=weights / weights.sum()))]

    def branch(self) -> RandomSampler:
        """Returns an independent sampler; what it draws does not change what this one draws."""
        return RandomSampler(self.rng.spawn(1)[0])

    def seed(self) -> int:
        """Returns a seed for a generator that is created later."""
        return int(self.rng.integers(2**31))
