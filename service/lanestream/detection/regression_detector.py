"""The regression detector: finds the two boundaries of the ego lane in one pass over the whole frame."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from lanestream.detection.curve_fit import Fits, FitSettings, fit_curves
from lanestream.detection.ego_prior import REGRESSOR_ANCHORS, RegressorOutput, RoadRegressor
from lanestream.detection.features import Channels
from lanestream.detection.interface import Detections, FrameContext, Infer
from lanestream.road.appearance import Appearance
from lanestream.road.results import Detection
from lanestream.road.view import Image, RoadView, visible_spans

# The network's curves are less exact than candidates, so the fit searches for paint farther away.
_FIT: Final = FitSettings(reach=0.24, rounds=(0.09, 0.06, 0.04))
# The fit's prior is the network's curve with its sigma times this factor, and at least this sigma, in depths.
_SIGMA_FACTOR: Final = 1.5
_LEAST_SIGMA: Final = 0.003


@dataclass(frozen=True)
class RegressionDetector:
    """Reports the regressor's boundaries after a fit to the paint under them."""

    regressor: RoadRegressor

    def detect(self, image: Image, context: FrameContext, infer: Infer) -> Detections:
        """Returns the ego boundaries in a BGR working image (H, 640, 3) uint8."""
        output, view = self.regressor.predict(
            image, context.horizon, infer, is_given=context.is_given, is_doubtful=context.is_doubtful
        )
        started = time.perf_counter()
        sides, fits = fit_output(Channels.of(image), output, view, self.regressor.threshold)
        spans = visible_spans(fits.curves, fits.view)
        found = [
            Detection(
                fits.curves[index],
                fits.covariances[index],
                float(spans.top[index]),
                float(spans.bottom[index]),
                float(output.presence[side]),
                float(fits.paint[index]),
                expected=True,
                appearance=Appearance(float(output.road_edge[side])),
            )
            for index, side in enumerate(sides)
            if spans.visible[index]
        ]
        fit_s = time.perf_counter() - started
        return Detections(tuple(found), fits.view, float(output.presence.max()), None, fit_s, output.uncertainty)


def fit_output(
    channels: Channels, output: RegressorOutput, view: RoadView, threshold: float, sides: Sequence[int] = (0, 1)
) -> tuple[list[int], Fits]:
    """Fits the present boundaries of an output (0 left, 1 right) among `sides` to the image under them.

    Returns the sides that were fitted, and their fits. `view` has the network's horizon.
    """
    curves = output.curves(view)
    spans = visible_spans(curves, view)
    present = [side for side in sides if output.presence[side] >= threshold and spans.visible[side]]
    sigma = np.maximum(_SIGMA_FACTOR * view.width * output.sigma[present], _LEAST_SIGMA * view.depth)
    chosen = np.array(present, np.intp)
    fits = fit_curves(
        channels,
        curves.take(chosen),
        spans.take(chosen),
        view,
        _FIT,
        sigma,
        REGRESSOR_ANCHORS,
        is_edge=output.road_edge[chosen] > 0.5,
    )
    return present, fits
