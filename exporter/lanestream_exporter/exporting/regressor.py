"""Export of the regressor: road crops in, the layout of `detection.ego_prior.RegressorOutput` out."""

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

from lanestream.detection.ego_prior import RoadRegressor
from lanestream.detection.interface import FrameContext, Infer, ModelRole
from lanestream.detection.regression_detector import RegressionDetector
from lanestream.images.decoding import ImageLimits, decode
from lanestream.inference.model_info import RegressorInfo
from lanestream.road.appearance import BOUNDARY_KINDS
from lanestream.road.crops import RoadCropGeometry
from lanestream.road.curve import FloatArray
from lanestream_exporter.exporting.compression import in_batches, run_in_pytorch, truncate_layers
from lanestream_exporter.exporting.exportable import (
    Calibration,
    ExportDescription,
    MetricValues,
    RunNetwork,
    ValidationSet,
    fit_calibration,
)
from lanestream_exporter.exporting.frames import ExportFrames
from lanestream_exporter.exporting.graph import contrast, exporter_versions
from lanestream_exporter.regressor import LaneRegressor, RegressorPrediction
from lanestream_exporter.samples.road_crops import SHARES, Warp, plain_warp, warped_road_crop
from lanestream_exporter.samples.road_frames import RoadFrame

_MAX_TRAINING_INPUTS: Final = 1024
_WARPS_PER_FRAME: Final = 5

# The shares of the row offset at which errors are reported: about 10 m and 30 m ahead of a camera at mirror height.
_NEAR, _FAR = SHARES.index(0.37), SHARES.index(0.12)

# A column is right within 5 pixels of a 640 pixel wide image.
_REFERENCE_WIDTH: Final = 640.0
_MAX_ERROR: Final = 5.0


class ServedRegressor(nn.Module):
    """The module to export: uint8 RGB road crops (N, H, W, 3) in, the layout of `RegressorOutput` (N, 17) out."""

    def __init__(self, network: LaneRegressor, temperature: float, half: bool = False) -> None:
        super().__init__()
        self.network = copy.deepcopy(network).half() if half else network
        self.dtype = torch.float16 if half else torch.float32
        self.temperature = temperature

    def forward(self, road_crops: Tensor) -> Tensor:
        """Returns the served outputs; only the network itself may run in half precision."""
        raw = RegressorPrediction.of(self.network(contrast(road_crops).to(self.dtype)).float())
        return replace(raw, presence=raw.presence / self.temperature).served()


@dataclass(frozen=True)
class ExportableRegressor:
    """A regressor without batch normalization layers."""

    network: LaneRegressor
    calibration: Calibration = Calibration()

    input_name = "road_crops"
    output_name = "readings"
    # These layers have few weights and take little time, but every output depends on them to a thousandth of the width.
    fp32_layers = ("network.features.0.", "network.hidden.", "network.column_head.", "network.auxiliary_head.")
    default_rank_energy = 0.9999
    guarded_metrics = ("accuracy", "presence_accuracy")

    @property
    def detector(self) -> RegressionDetector:
        """Returns the detector that will run the file."""
        return RegressionDetector(RoadRegressor(self.calibration.threshold, self._geometry))

    @property
    def _geometry(self) -> RoadCropGeometry:
        return RoadCropGeometry(self.network.size.size)

    def infer(self, run: RunNetwork) -> Infer:
        """Returns what the detector calls for outputs: `run`."""
        return lambda _, inputs: run(inputs)

    def training_inputs(self, frames: ExportFrames) -> NDArray[np.uint8]:
        """Returns road crops (N, size, size, 3) of training frames, as they are and warped to other cameras."""
        rng = np.random.default_rng(0)
        road_frames = frames.road_frames("train")
        crops = [
            warped_road_crop(frame, self._geometry, warp)[0] for frame in road_frames for warp in _warps(frame, rng)
        ]
        return np.stack([crops[i] for i in rng.permutation(len(crops))[:_MAX_TRAINING_INPUTS]])

    def validation_set(self, frames: ExportFrames) -> ValidationSet:
        """Returns validation frames, each with a known and with an unknown horizon. Raises LabelError.

        They have the detail width, to which the regressor reduces a working image.
        """
        run = run_in_pytorch(self.serving_module())
        inputs: list[NDArray[np.uint8]] = []

        def record(_: ModelRole, crops: NDArray[np.uint8]) -> NDArray[np.float32]:
            inputs.append(crops)
            return run(crops)

        images, contexts, targets = [], [], []
        road_frames = frames.road_frames("val")
        for frame in road_frames:
            image = decode(frame.jpeg, ImageLimits())
            target = warped_road_crop(frame, self._geometry, plain_warp(frame, known=True))[1]
            for horizon in (frame.horizon, None):
                images.append(image)
                contexts.append(FrameContext(horizon))
                targets.append((target.columns, target.known, target.presence, target.road_edge, frame.horizon))
                self.detector.regressor.predict(image, horizon, record)
        names = ("columns", "known", "presence", "road_edge", "horizon")
        truth = {name: np.array(values) for name, values in zip(names, zip(*targets, strict=True), strict=True)}
        return ValidationSet(len(road_frames), tuple(images), tuple(contexts), np.concatenate(inputs), truth)

    def compressed(self, energy: float, inputs: NDArray[np.uint8]) -> ExportableRegressor:
        """Returns the network with a truncated hidden layer."""
        small = copy.deepcopy(self.network)
        features = in_batches(lambda part: torch.flatten(small.features(contrast(part)), 1), inputs)
        small.hidden = truncate_layers(small.hidden, features, energy)
        return replace(self, network=small)

    def calibrated(self, validation: ValidationSet) -> ExportableRegressor:
        """Returns the network with temperature and threshold of presence fitted where the labels define presence."""
        uncalibrated = self.with_calibration(Calibration()).serving_module()
        presence = self._read(run_in_pytorch(uncalibrated), validation)[1]
        truth = validation.truth["presence"]
        logits = logit(np.clip(presence[truth >= 0.0], 1e-6, 1.0 - 1e-6))
        pairs = np.stack([np.zeros_like(logits), logits], axis=1).astype(np.float32)
        return self.with_calibration(fit_calibration(pairs, truth[truth >= 0.0].astype(np.int64)))

    def with_calibration(self, calibration: Calibration) -> ExportableRegressor:
        """Returns the network with the given temperature and threshold."""
        return replace(self, calibration=calibration)

    def serving_module(self, half: bool = False) -> ServedRegressor:
        """Returns the module to export; `half`: its network in float16."""
        return ServedRegressor(self.network, self.calibration.temperature, half).eval()

    def metrics(self, run: RunNetwork, validation: ValidationSet) -> MetricValues:
        """Returns the shares of right columns, presences and kinds, and mean lateral errors in pixels at 640 wide."""
        columns, presence, road_edge = self._read(run, validation)
        error = _REFERENCE_WIDTH * np.abs(columns - validation.truth["columns"])
        labeled = validation.truth["known"] >= 1.0
        true_presence = validation.truth["presence"]
        defined = true_presence >= 0.0
        accepted = presence >= self.calibration.threshold
        true_edge = validation.truth["road_edge"]
        known = true_edge >= 0.0
        return {
            "accuracy": _mean(error[labeled] <= _MAX_ERROR),
            "presence_accuracy": _mean((accepted == (true_presence > 0.0))[defined]),
            "kind_accuracy": _mean(((road_edge > 0.5) == (true_edge > 0.5))[known]),
            "error_near_px": _mean(error[:, :, _NEAR][labeled[:, :, _NEAR]]),
            "error_far_px": _mean(error[:, :, _FAR][labeled[:, :, _FAR]]),
        }

    def info(self, description: ExportDescription) -> RegressorInfo:
        """Returns the metadata of the file."""
        return RegressorInfo(
            kind="regressor",
            name=description.name,
            version=description.version,
            kinds=BOUNDARY_KINDS,
            road_crop=self._geometry,
            threshold=self.calibration.threshold,
            precision=description.precision,
            training={**description.training, "presence_temperature": round(self.calibration.temperature, 4)},
            metrics=description.metrics,
            exporter=exporter_versions(),
        )

    def _read(self, run: RunNetwork, validation: ValidationSet) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Returns what the detector reads from the outputs of `run` for P validation images.

        Columns (P, 2, S) at `SHARES` of the true row offset, in image widths from the center; presence and road_edge
        (P, 2).
        """
        columns, presence, road_edge = [], [], []
        frames = zip(validation.images, validation.contexts, validation.truth["horizon"], strict=True)
        for image, context, horizon in frames:
            output, view = self.detector.regressor.predict(image, context.horizon, self.infer(run))
            rows = horizon + np.array(SHARES) * (view.bottom - horizon)
            columns.append((output.curves(view).x(rows) - view.middle) / view.width)
            presence.append(output.presence)
            road_edge.append(output.road_edge)
        return np.array(columns), np.array(presence), np.array(road_edge)


def _warps(frame: RoadFrame, rng: np.random.Generator) -> Iterator[Warp]:
    yield plain_warp(frame, known=True)
    yield plain_warp(frame, known=False)
    for _ in range(_WARPS_PER_FRAME):
        yield Warp.random(rng)


def _mean(values: NDArray[np.bool_] | NDArray[np.float64]) -> float:
    return float(values.mean()) if values.size else float("nan")
