"""The regressor's network and loss."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
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
        "road_edge": torch.zeros(4, 2),
        "horizon": torch.zeros(4),
    }
    log_sigma, sure = torch.full((4, 2, 3), -5.0), torch.full((4, 2), 8.0)
    right = RegressorPrediction(columns, log_sigma, sure, torch.zeros(4), -sure)
    for worse in (
        replace(right, columns=columns + 0.02),
        replace(right, log_deviations=log_sigma + 2.0),
        replace(right, presence=-sure),
        replace(right, horizon=torch.full((4,), 0.1)),
        replace(right, road_edge=sure),
    ):
        assert lateral_loss(worse, truth) > lateral_loss(right, truth) + 0.05


def test_kinds_and_presences_count_where_they_are_known() -> None:
    columns, sure = torch.zeros(1, 2, 3), torch.tensor([[9.0, -9.0]])
    truth = {
        "columns": columns @ at_shares().T,
        "known": torch.ones(1, 2, len(SHARES)),
        "presence": torch.tensor([[1.0, -1.0]]),
        "road_edge": torch.tensor([[-1.0, 0.0]]),
        "horizon": torch.zeros(1),
    }
    right = RegressorPrediction(columns, torch.full((1, 2, 3), -5.0), sure, torch.zeros(1), sure)
    same = replace(right, presence=torch.tensor([[9.0, 9.0]]), road_edge=torch.tensor([[-9.0, -9.0]]))
    assert lateral_loss(same, truth) == lateral_loss(right, truth)
    wrong_kind = replace(right, road_edge=torch.tensor([[9.0, 9.0]]))
    assert lateral_loss(wrong_kind, truth) == pytest.approx(float(lateral_loss(right, truth)) + 0.15 * 9.0, rel=1e-4)
    nothing = {**truth, "road_edge": torch.full((1, 2), -1.0), "presence": torch.full((1, 2), -1.0)}
    assert torch.isfinite(lateral_loss(right, nothing))


def test_the_served_layout_is_the_one_that_the_service_reads() -> None:
    raw = torch.randn(3, 17, generator=torch.Generator().manual_seed(1))
    prediction = RegressorPrediction.of(raw)
    for index, row in enumerate(prediction.served().numpy()):
        output = RegressorOutput.of(row)
        np.testing.assert_allclose(output.columns, prediction.columns[index], rtol=1e-6)
        np.testing.assert_allclose(output.sigma, prediction.log_deviations[index].exp(), rtol=1e-6)
        np.testing.assert_allclose(output.presence, torch.sigmoid(raw[index, 12:14]), rtol=1e-6)
        np.testing.assert_allclose(output.road_edge, torch.sigmoid(raw[index, 15:17]), rtol=1e-6)
        assert output.horizon == pytest.approx(float(raw[index, 14]))


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
        assert folded(crops).shape == RegressorPrediction.of(folded(crops)).served().shape == (2, 17)
