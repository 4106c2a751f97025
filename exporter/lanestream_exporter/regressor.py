"""The lane regressor in PyTorch: AlexNet up to its first hidden layer, then 16 units, then two parabolas.

Source: MathWorks, "Deep learning for automated driving, part 2: lane detection", 2017: the network regresses the
coefficients of both boundaries of the ego lane. This one also predicts the presence, the kind and the standard
deviation of each boundary and the horizon, and it learns from lateral errors at rows rather than from errors of the
coefficients.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_linear_bn_eval

from lanestream.detection.ego_prior import REGRESSOR_ANCHORS
from lanestream_exporter.alexnet import FULL, AlexNet, Shape
from lanestream_exporter.samples.road_crops import SHARES

# Standard deviations are predicted as logarithms in image widths, within these limits.
_MIN_LOG, _MAX_LOG = -7.5, 0.0

# Typical columns of both boundaries at the anchors; the network learns the difference from them.
_TYPICAL = ((-0.36, -0.15, -0.06), (0.36, 0.15, 0.06))


class LaneRegressor(nn.Module):
    """AlexNet's convolutions and first hidden layer, then 16 units and the columns of two boundaries at three rows.

    Columns at three image rows determine a parabola on the ground as well as its coefficients do. They are all of the
    same magnitude, which makes them easier to learn.
    """

    def __init__(self, size: Shape = FULL, *, batch_norm: bool = True, dropout: float = 0.1) -> None:
        super().__init__()
        self.size = size
        trunk = AlexNet(shape=size, batch_norm=batch_norm)
        self.features, self.norms = trunk.features, trunk.norms
        self.hidden = nn.Sequential(nn.Dropout(dropout), *_linear(size.features, size.hidden, batch_norm), nn.ReLU())
        self.column_head = nn.Sequential(*_linear(size.hidden, 16, batch_norm), nn.ReLU(), nn.Linear(16, 6))
        self.auxiliary_head = nn.Linear(size.hidden, 11)

    def forward(self, x: Tensor) -> Tensor:
        """Returns raw outputs (N, 17) of normalized road crops (N, 3, size, size).

        They are columns at the anchors, in image widths from the typical ones, logarithms of their standard deviations,
        presence logits, the horizon's offset as a share of the rows below the assumed horizon, and road edge logits.
        """
        for index, layer in enumerate(self.features):
            x = layer(x)
            if str(index) in self.norms:
                x = self.norms[str(index)](x)
        hidden = self.hidden(torch.flatten(x, 1))
        return torch.cat([self.column_head(hidden), self.auxiliary_head(hidden)], dim=1)

    def folded(self) -> LaneRegressor:
        """Returns the same function without normalization layers: each is folded into the layer before it."""
        plain = LaneRegressor(self.size, batch_norm=False)
        trunk = AlexNet(shape=self.size)
        trunk.features, trunk.norms = self.features, self.norms
        plain.features = trunk.folded().features
        plain.hidden[1] = _fused(self.hidden[1], self.hidden[2])
        plain.column_head[0] = _fused(self.column_head[0], self.column_head[1])
        plain.column_head[2] = copy.deepcopy(self.column_head[3])
        plain.auxiliary_head = copy.deepcopy(self.auxiliary_head)
        return plain.eval()


def _fused(linear: nn.Module, norm: nn.Module) -> nn.Linear:
    assert isinstance(linear, nn.Linear) and isinstance(norm, nn.BatchNorm1d)  # noqa: S101, PT018 - for mypy
    return fuse_linear_bn_eval(linear.eval(), norm.eval())


def _linear(inputs: int, outputs: int, batch_norm: bool) -> list[nn.Module]:
    """Returns a linear layer; without batch normalization most of its units die in the first hundred steps."""
    return [nn.Linear(inputs, outputs), *([nn.BatchNorm1d(outputs)] if batch_norm else [])]


@dataclass(frozen=True)
class RegressorPrediction:
    """Raw outputs by meaning: columns and log deviations (N, 2, 3), presence logits (N, 2), horizon (N,).

    `road_edge` (N, 2) are the logits of a boundary being an edge of the road rather than a marking.
    """

    columns: Tensor
    log_deviations: Tensor
    presence: Tensor
    horizon: Tensor
    road_edge: Tensor

    @classmethod
    def of(cls, raw: Tensor) -> RegressorPrediction:
        """Returns the prediction in raw outputs (N, 17)."""
        typical = torch.tensor(_TYPICAL, dtype=raw.dtype)
        logs = raw[:, 6:12].view(-1, 2, 3).clamp(_MIN_LOG, _MAX_LOG)
        return cls(raw[:, :6].view(-1, 2, 3) + typical, logs, raw[:, 12:14], raw[:, 14], raw[:, 15:17])

    def served(self) -> Tensor:
        """Returns outputs (N, 17) in the layout of `lanestream.detection.ego_prior.RegressorOutput`."""
        return torch.cat(
            [
                self.columns.flatten(1),
                self.log_deviations.exp().flatten(1),
                torch.sigmoid(self.presence),
                self.horizon[:, None],
                torch.sigmoid(self.road_edge),
            ],
            dim=1,
        )


def at_shares() -> Tensor:
    """Returns the matrix (S, 3) from columns at the anchors to columns at `SHARES` of the rows below the horizon."""
    basis = [np.stack([np.ones(len(s)), s, 1.0 / s], axis=1) for s in (np.array(SHARES), REGRESSOR_ANCHORS)]
    return torch.tensor(basis[0] @ np.linalg.inv(basis[1]), dtype=torch.float32)


def logs_at_shares() -> Tensor:
    """Returns the matrix (S, 3) that interpolates logarithms from the anchors to `SHARES`, linearly in log shares."""
    anchors = np.log(REGRESSOR_ANCHORS)[::-1]
    rows = [np.interp(np.log(np.array(SHARES)), anchors, np.eye(3)[::-1][:, i]) for i in range(3)]
    return torch.tensor(np.stack(rows, axis=1), dtype=torch.float32)


def lateral_loss(prediction: RegressorPrediction, targets: dict[str, Tensor]) -> Tensor:
    """Returns the loss of lateral errors at rows, of their predicted deviations, of presence, kind and horizon.

    `targets` are the stacked fields of `road_crops.RegressionTarget`. Errors far away, where a meter has fewer pixels,
    weigh more. The deviations learn from the lateral errors without influencing them.
    """
    columns = prediction.columns @ at_shares().T
    error = (columns - targets["columns"]).abs()
    known = targets["known"]
    weight = known / torch.tensor(SHARES).sqrt()
    lateral = (torch.where(error < 0.004, error**2 / 0.008, error - 0.002) * weight).sum() / weight.sum().clamp(min=1.0)
    logs = prediction.log_deviations @ logs_at_shares().T
    deviation = ((error.detach() / logs.exp() + logs) * known).sum() / known.sum().clamp(min=1.0)
    presence = _binary_loss(prediction.presence, targets["presence"])
    kind = _binary_loss(prediction.road_edge, targets["road_edge"])
    # Unknown horizons are NaN, also for the gradient if they took part in the difference.
    is_known = targets["horizon"].isfinite()
    horizon = ((prediction.horizon - targets["horizon"].nan_to_num()).abs() * is_known).mean()
    return 30.0 * lateral + 0.1 * deviation + 0.3 * presence + 0.15 * kind + 5.0 * horizon


def _binary_loss(logits: Tensor, truth: Tensor) -> Tensor:
    """Returns the mean cross entropy of logits where the truth, 0 or 1, is known; it is -1 where it is not."""
    known = (truth >= 0.0).float()
    total = functional.binary_cross_entropy_with_logits(logits, truth.clamp(min=0.0), weight=known, reduction="sum")
    return total / known.sum().clamp(min=1.0)
