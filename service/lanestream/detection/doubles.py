"""Double lines: two stripes side by side are one boundary, which runs between them.

A fit settles on the stripe that is seen better, on one in this frame and on the other in the next. Along the fit both
stripes are straight, so that their contrast adds up over the rows and each is a peak of the mean row.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.bars import BarSearch


@dataclass(frozen=True)
class DoubleLines:
    """The search's settings; widths are shares of the rows below the horizon.

    A stripe shows a contrast of `least` on `share` of the rows at least, no farther than `reach` from the fit. The
    stripes of a double line are between `gaps[0]` and `gaps[1]` apart from middle to middle.
    """

    bars: BarSearch = BarSearch(reach=0.4, cells=129, rows=24, top_share=0.2, widths=(0.05, 0.09))
    least: float = 0.06
    share: float = 0.3
    reach: float = 0.2
    gaps: tuple[float, float] = (0.07, 0.25)

    def middle(self, bars: NDArray[np.float32]) -> float:
        """Where the middle of a double line is beside the fit whose `bars` (rows, cells) these are; 0 without one."""
        places = self._stripes(bars)
        if len(places) < 2:
            return 0.0
        nearest = min(places, key=abs)
        others = [place for place in places if self.gaps[0] <= abs(place - nearest) <= self.gaps[1]]
        return 0.5 * (nearest + others[0]) if others else 0.0

    def _stripes(self, bars: NDArray[np.float32]) -> list[float]:
        """Where stripes are beside the fit, the clearest one first."""
        across = self.bars.across()
        mean = bars.mean(axis=0)
        # A fit that is a little off lets a stripe wander from cell to cell.
        shown = cv2.dilate((bars > self.least).astype(np.uint8), np.ones((1, 3), np.uint8)).mean(axis=0)
        peak = (mean[1:-1] >= mean[:-2]) & (mean[1:-1] > mean[2:])
        stripes = 1 + np.flatnonzero(peak & (shown[1:-1] >= self.share) & (np.abs(across[1:-1]) <= self.reach))
        return [float(across[cell]) for cell in stripes[np.argsort(-mean[stripes], kind="stable")]]
