"""The second published network: AlexNet up to its first hidden layer, then 16 units, then two parabolas.

Source: MathWorks, "Deep learning for automated driving, part 2: lane detection", 2017: the network regresses the
coefficients of both boundaries of the ego lane. Beside them this one tells whether each boundary is there, how exactly
it is known, and where the horizon is; and it learns from lateral errors at rows, not from errors of coefficients.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_linear_bn_eval

from lanestream.detection.regression_detector import ANCHORS
from lanestream_exporter.alexnet import FULL, AlexNet, Shape
from lanestream_exporter.samples.road_crops import SHARES

# Standard deviations are told as logarithms in image widths, within what pixels and roads allow.
_LEAST_LOG, _MOST_LOG = -7.5, 0.0

# Where both boundaries usually run, at the anchors: the network learns what differs from it.
_USUAL = ((-0.36, -0.15, -0.06), (0.36, 0.15, 0.06))


class LaneRegressor(nn.Module):
    """AlexNet's convolutions and first hidden layer, then 16 units and the columns of two boundaries at three rows.

    A parabola of the ground is told by its columns at three rows of the picture as well as by its coefficients; the
    columns are all of one size, which a network learns more easily.
    """

    def __init__(self, size: Shape = FULL, *, normalised: bool = True, dropout: float = 0.1) -> None:
        super().__init__()
        self.size = size
        trunk = AlexNet(shape=size, normalised=normalised)
        self.features, self.norms = trunk.features, trunk.norms
        self.hidden = nn.Sequential(nn.Dropout(dropout), *_linear(size.features, size.hidden, normalised), nn.ReLU())
        self.shape = nn.Sequential(*_linear(size.hidden, 16, normalised), nn.ReLU(), nn.Linear(16, 6))
        self.doubts = nn.Linear(size.hidden, 9)

    def forward(self, x: Tensor) -> Tensor:
        """Raw outputs (N, 15) of normalised canvases (N, 3, size, size).

        Columns at the anchors in image widths from their usual ones, logarithms of their standard deviations, logits of
        presence, the horizon's distance in depths.
        """
        for index, layer in enumerate(self.features):
            x = layer(x)
            if str(index) in self.norms:
                x = self.norms[str(index)](x)
        hidden = self.hidden(torch.flatten(x, 1))
        return torch.cat([self.shape(hidden), self.doubts(hidden)], dim=1)

    def folded(self) -> LaneRegressor:
        """The same function without normalisation layers: each goes into the convolution before it."""
        plain = LaneRegressor(self.size, normalised=False)
        trunk = AlexNet(shape=self.size)
        trunk.features, trunk.norms = self.features, self.norms
        plain.features = trunk.folded().features
        plain.hidden[1] = _fused(self.hidden[1], self.hidden[2])
        plain.shape[0] = _fused(self.shape[0], self.shape[1])
        plain.shape[2], plain.doubts = copy.deepcopy(self.shape[3]), copy.deepcopy(self.doubts)
        return plain.eval()


def _fused(linear: nn.Module, norm: nn.Module) -> nn.Linear:
    assert isinstance(linear, nn.Linear) and isinstance(norm, nn.BatchNorm1d)  # noqa: S101, PT018 - tells mypy
    return fuse_linear_bn_eval(linear.eval(), norm.eval())


def _linear(inputs: int, outputs: int, normalised: bool) -> list[nn.Module]:
    """A linear layer, normalised while it trains: without that most of its units die in the first hundred steps."""
    return [nn.Linear(inputs, outputs), *([nn.BatchNorm1d(outputs)] if normalised else [])]


@dataclass(frozen=True)
class Answer:
    """Raw outputs, told apart: columns (N, 2, 3), log deviations (N, 2, 3), presence logits (N, 2), horizon (N,)."""

    columns: Tensor
    log_deviations: Tensor
    presence: Tensor
    horizon: Tensor

    @classmethod
    def of(cls, raw: Tensor) -> Answer:
        """The answer in raw outputs (N, 15)."""
        usual = torch.tensor(_USUAL, dtype=raw.dtype)
        logs = raw[:, 6:12].view(-1, 2, 3).clamp(_LEAST_LOG, _MOST_LOG)
        return cls(raw[:, :6].view(-1, 2, 3) + usual, logs, raw[:, 12:14], raw[:, 14])

    def told(self) -> Tensor:
        """What is served (N, 15): the layout of `lanestream.detection.regression_detector.RegressorOutput`."""
        return torch.cat(
            [
                self.columns.flatten(1),
                self.log_deviations.exp().flatten(1),
                torch.sigmoid(self.presence),
                self.horizon[:, None],
            ],
            dim=1,
        )


def at_shares() -> Tensor:
    """The matrix (S, 3) that takes columns at the anchors to columns at `SHARES` of the depth."""
    basis = [np.stack([np.ones(len(s)), s, 1.0 / s], axis=1) for s in (np.array(SHARES), np.array(ANCHORS))]
    return torch.tensor(basis[0] @ np.linalg.inv(basis[1]), dtype=torch.float32)


def logs_at_shares() -> Tensor:
    """The matrix (S, 3) that interpolates logarithms from the anchors to `SHARES`, linearly in log shares."""
    anchors = np.log(np.array(ANCHORS))[::-1]
    rows = [np.interp(np.log(np.array(SHARES)), anchors, np.eye(3)[::-1][:, i]) for i in range(3)]
    return torch.tensor(np.stack(rows, axis=1), dtype=torch.float32)


def lateral_loss(answer: Answer, targets: dict[str, Tensor]) -> Tensor:
    """Lateral errors at rows, the honesty of their deviations, presence and horizon, in one number.

    `targets` are the fields of `canvases.Target`, stacked. An error counts more where the road is farther away and its
    pixels fewer; the deviations learn from errors that they cannot change.
    """
    columns = answer.columns @ at_shares().T
    error = (columns - targets["columns"]).abs()
    known = targets["known"]
    weight = known / torch.tensor(SHARES).sqrt()
    lateral = (torch.where(error < 0.004, error**2 / 0.008, error - 0.002) * weight).sum() / weight.sum().clamp(min=1.0)
    logs = answer.log_deviations @ logs_at_shares().T
    doubt = ((error.detach() / logs.exp() + logs) * known).sum() / known.sum().clamp(min=1.0)
    told = (targets["presence"] >= 0.0).float()
    there = functional.binary_cross_entropy_with_logits(
        answer.presence, targets["presence"].clamp(min=0.0), weight=told, reduction="sum"
    ) / told.sum().clamp(min=1.0)
    horizon = (answer.horizon - targets["horizon"]).abs().mean()
    return 30.0 * lateral + 0.1 * doubt + 0.3 * there + 5.0 * horizon
