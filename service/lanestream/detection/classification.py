"""The classifier's outputs for the candidates of a frame, by meaning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.road.appearance import BOUNDARY_KINDS, MARKING_COLORS, MARKING_TYPES, Appearance
from lanestream.road.curve import FloatArray

_TYPES: Final = slice(1 + len(BOUNDARY_KINDS), 1 + len(BOUNDARY_KINDS) + len(MARKING_TYPES))
_COLORS: Final = slice(_TYPES.stop, _TYPES.stop + len(MARKING_COLORS))
# Networks before 0.13 return only the probabilities of nothing and of a boundary.
_OLDER_OUTPUTS: Final = 2


@dataclass(frozen=True)
class Classification:
    """What N candidates are.

    `kinds` (N, 2) are the probabilities of a marking and of a road edge; the rest is that of nothing. `types` (N, 4)
    and `colors` (N, 2) are those of a marking's type and color; None if the network does not classify markings.
    """

    kinds: FloatArray
    types: FloatArray | None = None
    colors: FloatArray | None = None

    @classmethod
    def of(cls, outputs: NDArray[np.float32]) -> Classification:
        """Reads the outputs (N, 9) of the network: nothing, marking, road edge, then types and colors.

        Those of an older network (N, 2) are nothing and marking.
        """
        values = outputs.astype(np.float64)
        if values.shape[1] == _OLDER_OUTPUTS:
            return cls(np.stack([values[:, 1], np.zeros(len(values))], axis=1))
        return cls(values[:, 1 : _TYPES.start], values[:, _TYPES], values[:, _COLORS])

    @property
    def boundary(self) -> FloatArray:
        """The probabilities (N,) of a boundary of any kind."""
        return np.asarray(self.kinds.sum(axis=1))

    def take(self, indices: NDArray[np.intp]) -> Classification:
        """Returns the classification of the candidates at `indices`."""
        types = None if self.types is None else self.types[indices]
        return Classification(self.kinds[indices], types, None if self.colors is None else self.colors[indices])

    def with_odds(self, odds: FloatArray) -> Classification:
        """Returns the classification after the odds of both kinds against nothing change by factors, `odds` (N, 2)."""
        kinds = self.kinds * odds
        nothing = np.maximum(1.0 - self.boundary, 0.0)
        # A floor, for outputs that are exactly 0 and 1.
        total = np.maximum(nothing + kinds.sum(axis=1), 1e-12)
        return Classification(kinds / total[:, None], self.types, self.colors)

    def appearances(self, weights: FloatArray) -> list[Appearance]:
        """Returns the appearances of M boundaries, each of which the candidates support with `weights` (M, N)."""
        shares = weights / weights.sum(axis=1, keepdims=True)
        kinds = shares @ self.kinds
        edges = kinds[:, 1] / np.maximum(kinds.sum(axis=1), 1e-12)
        if self.types is None or self.colors is None:
            return [Appearance(edge) for edge in edges.tolist()]
        types, colors = shares @ self.types, shares @ self.colors
        rows = zip(edges.tolist(), types.tolist(), colors.tolist(), strict=True)
        return [Appearance(edge, tuple(of_types), tuple(of_colors)) for edge, of_types, of_colors in rows]
