"""The regressor's task: whole frames, rendered and real, warped as other cameras and roads would show them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lanestream.errors import CheckpointError
from lanestream.road.crops import RoadCropGeometry
from lanestream.road.curve import FloatArray
from lanestream_exporter.alexnet import normalize
from lanestream_exporter.regressor import LaneRegressor, RegressorPrediction, at_shares, lateral_loss
from lanestream_exporter.samples.augment import corrupted
from lanestream_exporter.samples.road_crops import SHARES, RegressionTarget, Warp, plain_warp, warped_road_crop
from lanestream_exporter.samples.road_frames import RoadFrame
from lanestream_exporter.training.config import RegressorConfig
from lanestream_exporter.training.data_sources import RoadFrameSource
from lanestream_exporter.training.loop import SELECTED_BY, Batch
from lanestream_exporter.training.shipped import initial_weights
from lanestream_exporter.weight_files import load_state, weights_in

# The rows at which lateral errors are reported: about 10 m and 30 m ahead of a typical dash camera.
_REPORTED = {"10m": SHARES.index(0.37), "30m": SHARES.index(0.12)}


class RegressorTask:
    """Trains `network` on the ego lane's boundaries in rendered and real frames.

    `origin` is recorded with the run: where the frames came from.
    """

    def __init__(
        self,
        config: RegressorConfig,
        network: LaneRegressor,
        sources: Sequence[RoadFrameSource],
        origin: dict[str, Any],
    ) -> None:
        self._config = config
        self._sources = {source.name: source for source in sources}
        self._chances = {source.name: frame_chances(source.train) for source in sources}
        self._geometry = RoadCropGeometry(config.network.size)
        self._checks = {source.name: self._unwarped(source.check) for source in sources}
        self.network = network
        counts = {s.name: {"train": len(s.train), "check": len(s.check)} for s in sources}
        self.data: dict[str, Any] = {**origin, **counts}

    def batch(self, step: int) -> Batch:
        """Returns road crops (N, H, W, 3) uint8 in RGB, and the fields of their targets."""
        config = self._config
        rng = np.random.default_rng([config.seed, step])
        share = config.data.real_share if step < config.steps * 2 // 3 else config.data.final_real_share
        real = round(config.batch * share)
        samples: list[tuple[NDArray[np.uint8], RegressionTarget]] = []
        for name, count in (("real", real), ("rendered", config.batch - real)):
            frames = self._draw(name, count, rng) if count else []
            samples += [warped_road_crop(frame, self._geometry, Warp.random(rng)) for frame in frames]
        crops = np.stack([corrupted(crop, config.corruptions, rng) for crop, _ in samples])
        return torch.from_numpy(crops), *_stacked([target for _, target in samples])

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Returns the loss of a batch; see `regressor.lateral_loss`."""
        crops, *targets = batch
        raw: Tensor = network(_normalized(crops))
        return lateral_loss(RegressorPrediction.of(raw.float()), _named(targets))

    def check(self, network: nn.Module) -> dict[str, float]:
        """Returns loss and lateral errors (pixels at 640 wide) of each source; the mean loss selects the network."""
        losses, figures = [], {}
        for name, (crops, *targets) in self._checks.items():
            parts = [network(_normalized(crops[i : i + 50])) for i in range(0, len(crops), 50)]
            prediction, named = RegressorPrediction.of(torch.cat(parts).float()), _named(targets)
            losses.append(float(lateral_loss(prediction, named)))
            figures[f"{name}_loss"] = losses[-1]
            for distance, error in lateral_errors(prediction, named).items():
                figures[f"{name}_px_{distance}"] = error
            for field in ("presence", "road_edge"):
                figures[f"{name}_{field}_accuracy"] = _share_right(getattr(prediction, field), named[field])
        return {SELECTED_BY: sum(losses) / len(losses), **figures}

    def _draw(self, name: str, count: int, rng: np.random.Generator) -> list[RoadFrame]:
        frames = self._sources[name].train
        return [frames[int(i)] for i in rng.choice(len(frames), size=count, p=self._chances[name])]

    def _unwarped(self, frames: Sequence[RoadFrame]) -> Batch:
        """Returns the crops of frames as served: with the horizon known, and unknown as at the start of a stream."""
        samples = [
            warped_road_crop(frame, self._geometry, plain_warp(frame, known))
            for known in (True, False)
            for frame in frames
        ]
        crops, targets = zip(*samples, strict=True)
        return torch.from_numpy(np.stack(crops)), *_stacked(list(targets))


def lateral_errors(prediction: RegressorPrediction, targets: dict[str, Tensor]) -> dict[str, float]:
    """Returns the mean distance from the labels in pixels at 640 wide, about 10 m and 30 m ahead."""
    error = 640.0 * (prediction.columns @ at_shares().T - targets["columns"]).abs()
    known = targets["known"] >= 1.0
    return {distance: float(error[:, :, i][known[:, :, i]].mean()) for distance, i in _REPORTED.items()}


def _share_right(logits: Tensor, truth: Tensor) -> float:
    """Returns the share of logits with the right sign where the truth, 0 or 1, is known; it is -1 where it is not."""
    known = truth >= 0.0
    return float(((logits[known] > 0.0) == (truth[known] > 0.5)).float().mean())


def frame_chances(frames: Sequence[RoadFrame]) -> FloatArray:
    """Returns the chances (N,) with which frames are drawn.

    Data sets, and the drives within each, count by the square root of their numbers of frames, so that none dominates.
    """
    _, sets, set_sizes = np.unique([frame.dataset for frame in frames], return_inverse=True, return_counts=True)
    _, drives, drive_sizes = np.unique([frame.group for frame in frames], return_inverse=True, return_counts=True)
    within = 1.0 / np.sqrt(drive_sizes[drives])
    chances = np.sqrt(set_sizes)[sets] * within / np.bincount(sets, within)[sets]
    return np.asarray(chances / chances.sum())


def starting_regressor(config: RegressorConfig) -> LaneRegressor:
    """Returns the network before its first step: random by the seed, with the convolutions of `initial` if given.

    `initial` is the checkpoint of a regressor or classifier run, or `shipped`. Raises CheckpointError for other files.
    """
    torch.manual_seed(config.seed)
    network = LaneRegressor(config.network.shape)
    if config.initial is None:
        return network
    state = weights_in(load_state(initial_weights(config.initial, "regressor")))
    wanted = network.state_dict()
    convolutions = [key for key in wanted if key.startswith(("features", "norms"))]
    if any(key not in state or state[key].shape != wanted[key].shape for key in convolutions):
        hint = "give the best.pt of a classifier or regressor run with the same [network] width"
        raise CheckpointError(f"{config.initial} does not hold the convolutions of this network", hint)
    fitting = {key: value for key, value in state.items() if key in wanted and value.shape == wanted[key].shape}
    network.load_state_dict(fitting, strict=False)
    return network


def _normalized(crops: Tensor) -> Tensor:
    # Convolutions on the CPU are faster with channels last.
    return normalize(crops).contiguous(memory_format=torch.channels_last)


_FIELDS = ("columns", "known", "presence", "road_edge", "horizon")


def _stacked(targets: Sequence[RegressionTarget]) -> tuple[Tensor, ...]:
    return tuple(
        torch.from_numpy(np.stack([np.asarray(getattr(target, field), np.float32) for target in targets]))
        for field in _FIELDS
    )


def _named(targets: Sequence[Tensor]) -> dict[str, Tensor]:
    return dict(zip(_FIELDS, targets, strict=True))
