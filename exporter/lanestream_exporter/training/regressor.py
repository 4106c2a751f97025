"""The regressor's task: whole frames, rendered and real, moved as other cameras and roads would show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import Field, NonNegativeInt, PositiveInt
from torch import Tensor, nn

from lanestream.detection.regression_detector import RoadCropGeometry
from lanestream.errors import CheckpointError, LabelError
from lanestream_exporter.alexnet import load_state, normalise
from lanestream_exporter.regressor import Answer, LaneRegressor, at_shares, lateral_loss
from lanestream_exporter.samples.augment import photographed
from lanestream_exporter.samples.road_crops import SHARES, Target, Warp, plain_warp, sample
from lanestream_exporter.samples.road_frames import RoadFrame
from lanestream_exporter.training.config import Light, NetworkSize, PatchData, Share, TrainConfig
from lanestream_exporter.training.loop import CHOOSES, Batch

# The shares of the depth whose lateral errors are told: about 10 m and 30 m ahead of a usual dash camera.
_TOLD = {"10m": SHARES.index(0.37), "30m": SHARES.index(0.12)}


class FrameData(PatchData):
    """Where frames come from, and which share of each batch is real: `final_real_share` in the last third."""

    rendered_scenes: NonNegativeInt = 14000
    validation_scenes: PositiveInt = 250
    real_share: Share = 0.4
    final_real_share: Share = 0.6


class RegressorConfig(TrainConfig):
    """The regressor's run."""

    steps: PositiveInt = 10000
    check_every: PositiveInt = 1000
    batch: int = Field(default=64, ge=2)
    ema: float = Field(default=0.998, ge=0.0, lt=1.0)
    clip: float = Field(default=5.0, ge=0.0)
    network: NetworkSize = NetworkSize(size=224, width=0.5, hidden=1024)
    data: FrameData = FrameData()
    light: Light = Light()


@dataclass(frozen=True)
class FrameSource:
    """Frames of one kind, `rendered` or `real`: those to train on, and those that choose the best network."""

    name: str
    train: Sequence[RoadFrame]
    check: Sequence[RoadFrame]

    def __post_init__(self) -> None:
        if not self.train or not self.check:
            raise LabelError(f"there are no {self.name} frames whose labels tell a horizon", "give more frames")


class RegressorTask:
    """Teaches `network` where the ego lane's boundaries run, by rendered and real frames."""

    def __init__(
        self, config: RegressorConfig, network: LaneRegressor, sources: Sequence[FrameSource], origin: dict[str, Any]
    ) -> None:
        self._config = config
        self._sources = {source.name: source for source in sources}
        self._geometry = RoadCropGeometry(config.network.size)
        self._checks = {source.name: self._plain(source.check) for source in sources}
        self.network = network
        counts = {s.name: {"train": len(s.train), "check": len(s.check)} for s in sources}
        self.data: dict[str, Any] = {**origin, **counts}

    def batch(self, step: int) -> Batch:
        """Canvases (N, H, W, 3) uint8 in RGB, and the fields of their targets."""
        config = self._config
        rng = np.random.default_rng([config.seed, step])
        share = config.data.real_share if step < config.steps * 2 // 3 else config.data.final_real_share
        real = round(config.batch * share)
        drawn: list[tuple[np.ndarray[Any, np.dtype[np.uint8]], Target]] = []
        for name, count in (("real", real), ("rendered", config.batch - real)):
            frames = drawn_frames(self._sources[name].train, count, rng) if count else []
            drawn += [sample(frame, self._geometry, Warp.drawn(rng)) for frame in frames]
        canvases = np.stack([photographed(canvas, config.light, rng) for canvas, _ in drawn])
        return torch.from_numpy(canvases), *_stacked([target for _, target in drawn])

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Lateral errors, presence and horizon in one number; see `regressor.lateral_loss`."""
        canvases, *targets = batch
        raw: Tensor = network(_prepared(canvases))
        return lateral_loss(Answer.of(raw.float()), _named(targets))

    def check(self, network: nn.Module) -> dict[str, float]:
        """Loss and lateral error of each source, in pixels at 640 wide; the mean loss chooses."""
        losses, figures = [], {}
        for name, (canvases, *targets) in self._checks.items():
            parts = [network(_prepared(canvases[i : i + 50])) for i in range(0, len(canvases), 50)]
            answer, named = Answer.of(torch.cat(parts).float()), _named(targets)
            losses.append(float(lateral_loss(answer, named)))
            figures[f"{name}_loss"] = losses[-1]
            for place, error in lateral_errors(answer, named).items():
                figures[f"{name}_px_{place}"] = error
        return {CHOOSES: sum(losses) / len(losses), **figures}

    def _plain(self, frames: Sequence[RoadFrame]) -> Batch:
        """Frames as they are served: once the horizon is known, and as the first of a stream, when it is not."""
        samples = [
            sample(frame, self._geometry, plain_warp(frame, known)) for known in (True, False) for frame in frames
        ]
        canvases, targets = zip(*samples, strict=True)
        return torch.from_numpy(np.stack(canvases)), *_stacked(list(targets))


def lateral_errors(answer: Answer, targets: dict[str, Tensor]) -> dict[str, float]:
    """Mean distance of both boundaries from labels in pixels at 640 wide, about 10 m and 30 m ahead."""
    error = 640.0 * (answer.columns @ at_shares().T - targets["columns"]).abs()
    known = targets["known"] >= 1.0
    return {place: float(error[:, :, i][known[:, :, i]].mean()) for place, i in _TOLD.items()}


def drawn_frames(frames: Sequence[RoadFrame], count: int, rng: np.random.Generator) -> list[RoadFrame]:
    """`count` random frames; a drive is drawn by the square root of its frames, so that a long one does not rule."""
    groups = np.array([frame.group for frame in frames])
    _, index, sizes = np.unique(groups, return_inverse=True, return_counts=True)
    shares = 1.0 / np.sqrt(sizes[index])
    return [frames[int(i)] for i in rng.choice(len(frames), size=count, p=shares / shares.sum())]


def starting_regressor(config: RegressorConfig) -> LaneRegressor:
    """The network before its first step: by the seed, its convolutions from `initial` where that is given.

    `initial` is the checkpoint of a regressor's or of a classifier's run. Raises CheckpointError where it is neither.
    """
    torch.manual_seed(config.seed)
    network = LaneRegressor(config.network.shape)
    if config.initial is None:
        return network
    state = load_state(Path(config.initial)).get("network")
    wanted = network.state_dict()
    convolutions = [key for key in wanted if key.startswith(("features", "norms"))]
    if not isinstance(state, dict) or any(
        key not in state or state[key].shape != wanted[key].shape for key in convolutions
    ):
        hint = "give the best.pt of a classifier's or a regressor's run with the same [network] width"
        raise CheckpointError(f"{config.initial} holds no convolutions of this network", hint)
    fitting = {key: value for key, value in state.items() if key in wanted and value.shape == wanted[key].shape}
    network.load_state_dict(fitting, strict=False)
    return network


def _prepared(canvases: Tensor) -> Tensor:
    # oneDNN's convolutions are faster with the channels last.
    return normalise(canvases).contiguous(memory_format=torch.channels_last)


_FIELDS = ("columns", "known", "presence", "horizon")


def _stacked(targets: Sequence[Target]) -> tuple[Tensor, ...]:
    return tuple(
        torch.from_numpy(np.stack([np.asarray(getattr(target, field), np.float32) for target in targets]))
        for field in _FIELDS
    )


def _named(targets: Sequence[Tensor]) -> dict[str, Tensor]:
    return dict(zip(_FIELDS, targets, strict=True))
