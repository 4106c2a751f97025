"""The regressor's network and loss."""

from __future__ import annotations

import numpy as np
import torch

from lanestream.detection.ego_prior import RegressorOutput
from lanestream_exporter.alexnet import Shape
from lanestream_exporter.regressor import LaneRegressor, RegressorPrediction, at_shares, lateral_loss, logs_at_shares
from lanestream_exporter.samples.road_crops import SHARES


def test_the_loss_is_lowest_at_the_truth() -> None:
    generator = torch.Generator().manual_seed(0)
    columns = torch.rand((4, 2, 3), generator=generator) - 0.5
    truth = {
        "columns": columns @ at_shares().T,
        "known": torch.ones(4, 2, len(SHARES)),
        "presence": torch.ones(4, 2),
        "horizon": torch.zeros(4),
    }
    log_sigma, presence = torch.full((4, 2, 3), -5.0), torch.full((4, 2), 8.0)
    best = lateral_loss(RegressorPrediction(columns, log_sigma, presence, torch.zeros(4)), truth)
    for worse in (
        RegressorPrediction(columns + 0.02, log_sigma, presence, torch.zeros(4)),
        RegressorPrediction(columns, log_sigma + 2.0, presence, torch.zeros(4)),
        RegressorPrediction(columns, log_sigma, -presence, torch.zeros(4)),
        RegressorPrediction(columns, log_sigma, presence, torch.full((4,), 0.1)),
    ):
        assert lateral_loss(worse, truth) > best + 0.05


def test_deviations_are_interpolated_between_the_anchors() -> None:
    weights = logs_at_shares()
    np.testing.assert_allclose(weights.sum(dim=1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(weights[0], [1.0, 0.0, 0.0], atol=1e-6)


def test_folding_keeps_the_function() -> None:
    torch.manual_seed(0)
    network = LaneRegressor(Shape(112, 0.5, 64))
    norms = torch.nn.BatchNorm1d, torch.nn.BatchNorm2d
    for norm in (module for module in network.modules() if isinstance(module, norms)):
        torch.nn.init.uniform_(norm.weight, 0.5, 1.5)
        torch.nn.init.uniform_(norm.running_var, 0.5, 1.5)  # type: ignore[arg-type]
        torch.nn.init.normal_(norm.running_mean)  # type: ignore[arg-type]
    network.eval()
    crops = torch.randn(2, 3, 112, 112)
    with torch.inference_mode():
        folded = network.folded()
        assert not [module for module in folded.modules() if isinstance(module, norms)]
        np.testing.assert_allclose(folded(crops), network(crops), rtol=1e-3, atol=1e-3)
        assert RegressorPrediction.of(folded(crops)).served().shape == (2, RegressorOutput.SIZE)
