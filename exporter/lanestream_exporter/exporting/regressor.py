"""Exporting the regressor: canonical pictures in, what `detection.regression.RegressorOutput` reads out."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import logit
from torch import Tensor, nn

from lanestream import __version__
from lanestream.detection.regression_detector import RegressionDetector, RoadCropGeometry
from lanestream.images.decoding import ImageLimits, decode
from lanestream.inference import RegressorInfo, RoadCropInfo
from lanestream.road.curve import FloatArray
from lanestream_exporter.exporting.calibration import Calibration, calibrated
from lanestream_exporter.exporting.compression import in_batches, truncated
from lanestream_exporter.exporting.frames import FrameSource
from lanestream_exporter.exporting.normalisation import contrast
from lanestream_exporter.exporting.subject import Check, Description, Figures
from lanestream_exporter.exporting.versions import exporter
from lanestream_exporter.regressor import LaneRegressor, RegressorPrediction
from lanestream_exporter.samples.road_crops import SHARES, Warp, plain_warp, warped_road_crop
from lanestream_exporter.samples.road_frames import RoadFrame

_MOST_RANGING: Final = 1024
_WARPS: Final = 5

# Where errors are told: about 10 m and 30 m ahead of a camera at the height of a car's mirror.
_NEAR, _FAR = SHARES.index(0.37), SHARES.index(0.12)

# A column is right within 5 pixels of a 640 pixel wide image.
_WIDE: Final = 640.0
_RIGHT: Final = 5.0


class ServedRegressor(nn.Module):
    """The graph: uint8 RGB canvases (N, H, W, 3) in, the layout of `RegressorOutput` (N, 15) out."""

    def __init__(self, network: LaneRegressor, temperature: float, half: bool = False) -> None:
        super().__init__()
        self.network = copy.deepcopy(network).half() if half else network
        self.dtype = torch.float16 if half else torch.float32
        self.temperature = temperature

    def forward(self, canvases: Tensor) -> Tensor:
        """Only the network itself is ever in half precision."""
        answer = RegressorPrediction.of(self.network(contrast(canvases).to(self.dtype)).float())
        return replace(answer, presence=answer.presence / self.temperature).served()


@dataclass(frozen=True)
class RegressorSubject:
    """A regressor without normalisation layers."""

    network: LaneRegressor
    calibration: Calibration = Calibration()

    name = "lanestream-regressor"
    input_name = "canvases"
    output_name = "readings"
    # Few weights and little time, but every output hangs on them, on a thousandth of an image's width.
    exact = ("network.features.0.", "network.hidden.", "network.column_head.", "network.auxiliary_head.")
    rank_energy = 0.99996
    headline = ("accuracy", "presence_accuracy")

    @property
    def detector(self) -> RegressionDetector:
        """The detector that will ask the file."""
        return RegressionDetector(self.calibration.threshold, RoadCropGeometry(self.network.size.size))

    def ranging(self, source: FrameSource) -> NDArray[np.uint8]:
        """Canvases (N, size, size, 3) of training frames, as they are and as other cameras would see them."""
        rng = np.random.default_rng(0)
        geometry = self.detector.geometry
        canvases = [
            warped_road_crop(frame, geometry, warp)[0] for frame in source.roads("train") for warp in _warps(frame, rng)
        ]  # fmt: skip
        return np.stack([canvases[i] for i in rng.permutation(len(canvases))[:_MOST_RANGING]])

    def check(self, source: FrameSource) -> Check:
        """Validation frames, each with its horizon known and not known. Raises LabelError."""
        prepared, targets = [], []
        frames = source.roads("val")
        for frame in frames:
            image = decode(frame.jpeg, ImageLimits())
            target = warped_road_crop(frame, self.detector.geometry, plain_warp(frame, known=True))[1]
            for horizon in (frame.horizon, None):
                prepared.append(self.detector.prepare(image, horizon))
                targets.append((target.columns, target.known, target.presence, frame.horizon))
        names = ("columns", "known", "presence", "horizon")
        truth = {name: np.array(values) for name, values in zip(names, zip(*targets, strict=True), strict=True)}
        return Check(len(frames), tuple(prepared), truth)

    def compressed(self, energy: float, inputs: NDArray[np.uint8]) -> RegressorSubject:
        """With a thinner hidden layer."""
        small = copy.deepcopy(self.network)
        seen = in_batches(lambda part: torch.flatten(small.features(contrast(part)), 1), inputs)
        small.hidden = truncated(small.hidden, seen, energy)
        return replace(self, network=small)

    def calibrated(self, check: Check) -> RegressorSubject:
        """With a temperature and a threshold of presence, where the labels tell presence and absence."""
        bare = in_batches(self.under(Calibration()).served(), check.inputs).numpy()
        presence, truth = self._read(bare, check)[1], check.truth["presence"]
        told = logit(np.clip(presence[truth >= 0.0], 1e-6, 1.0 - 1e-6))
        pairs = np.stack([np.zeros_like(told), told], axis=1).astype(np.float32)
        return self.under(calibrated(pairs, truth[truth >= 0.0].astype(np.int64)))

    def under(self, calibration: Calibration) -> RegressorSubject:
        """With a temperature and a threshold."""
        return replace(self, calibration=calibration)

    def served(self, half: bool = False) -> ServedRegressor:
        """The graph; `half`: its network in float16."""
        return ServedRegressor(self.network, self.calibration.temperature, half).eval()

    def figures(self, outputs: NDArray[np.float32], check: Check) -> Figures:
        """Shares of right columns and presences, and mean lateral errors in pixels of a 640 pixel wide image."""
        columns, told_presence = self._read(outputs, check)
        error = _WIDE * np.abs(columns - check.truth["columns"])
        labelled = check.truth["known"] >= 1.0
        presence = check.truth["presence"]
        told = presence >= 0.0
        there = told_presence >= self.calibration.threshold
        return {
            "accuracy": _mean(error[labelled] <= _RIGHT),
            "presence_accuracy": _mean((there == (presence > 0.0))[told]),
            "error_near_px": _mean(error[:, :, _NEAR][labelled[:, :, _NEAR]]),
            "error_far_px": _mean(error[:, :, _FAR][labelled[:, :, _FAR]]),
        }

    def info(self, description: Description) -> RegressorInfo:
        """What the file says of itself."""
        detector = self.detector
        canvas = RoadCropInfo(
            size=detector.geometry.size,
            above=detector.geometry.above,
            narrowest=detector.geometry.narrowest,
            detail_width=detector.detail_width,
        )
        training = {**description.training, "presence_temperature": round(self.calibration.temperature, 4)}
        return RegressorInfo(
            kind="regressor",
            name=description.name,
            version=__version__,
            canvas=canvas,
            threshold=self.calibration.threshold,
            precision=description.precision,
            training=training,
            metrics=description.metrics,
            exporter=exporter(),
        )

    def _read(self, outputs: NDArray[np.float32], check: Check) -> tuple[FloatArray, FloatArray]:
        """What the detector reads in outputs: columns (P, 2, S) at `SHARES` of the true depth, presence (P, 2).

        Columns are in image widths from the middle; P counts the prepared frames.
        """
        columns, presence = [], []
        frames = zip(check.prepared, check.by_frame(outputs), check.truth["horizon"], strict=True)
        for prepared, part, horizon in frames:
            reading, view = self.detector.read(prepared, part)
            rows = horizon + np.array(SHARES) * (view.bottom - horizon)
            x = np.stack([reading.curve(side, view).x(rows) for side in (0, 1)])
            columns.append((x - (view.width - 1) / 2.0) / view.width)
            presence.append(reading.presence)
        return np.array(columns), np.array(presence)


def _warps(frame: RoadFrame, rng: np.random.Generator) -> Iterator[Warp]:
    yield plain_warp(frame, known=True)
    yield plain_warp(frame, known=False)
    for _ in range(_WARPS):
        yield Warp.random(rng)


def _mean(values: NDArray[np.bool_] | NDArray[np.float64]) -> float:
    return float(values.mean()) if values.size else float("nan")
