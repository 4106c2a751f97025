"""Making AlexNet small: its fully connected layers hold 54 of its 57 million weights, and need few of them."""

from __future__ import annotations

import copy

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lanestream_exporter.alexnet import AlexNet, normalise


@torch.inference_mode()
def truncated(network: AlexNet, energy: float, patches: NDArray[np.uint8]) -> AlexNet:
    """A copy whose hidden linear layers keep the directions that hold the share `energy` of their outputs' variance.

    The variance is that over RGB `patches` (N, H, W, 3) uint8: what the layers do to roads, not what their weights
    could do to anything, most of which is the noise they were initialised with. Each layer becomes two thinner ones in
    a row; 1.0 keeps them as they are. Source: X. Zhang et al., "Accelerating very deep convolutional networks", 2015,
    section 3.1 (principal components of responses).
    """
    small = copy.deepcopy(network).eval()
    if energy >= 1.0:
        return small
    parts = [torch.from_numpy(patches[i : i + 32]) for i in range(0, len(patches), 32)]
    x = torch.cat([torch.flatten(small.features(normalise(part)), 1) for part in parts])
    for index, layer in enumerate(small.classifier):
        y = layer(x)
        if isinstance(layer, nn.Linear) and layer.out_features > small.classes:
            small.classifier[index] = _factored(layer, y, energy)
        x = y
    return small


def _factored(layer: nn.Linear, outputs: Tensor, energy: float) -> nn.Sequential:
    """Two layers that reproduce `outputs` (N, out) of `layer` in their strongest principal components."""
    mean = outputs.mean(dim=0)
    centred = outputs - mean
    # Of N outputs there are at most N components: their Gram matrix is smaller than the layer's covariance.
    values, vectors = torch.linalg.eigh(centred @ centred.T)
    values, vectors = values.flip(0).clamp(min=0.0), vectors.flip(1)
    held = torch.cumsum(values, 0) / values.sum()
    rank = min(int(torch.searchsorted(held, energy).item()) + 1, len(values))
    directions = centred.T @ vectors[:, :rank] / values[:rank].sqrt()
    first = nn.Linear(layer.in_features, rank, bias=False)
    second = nn.Linear(rank, layer.out_features)
    first.weight.data = directions.T @ layer.weight
    second.weight.data = directions
    second.bias.data = mean + directions @ (directions.T @ (layer.bias - mean))
    return nn.Sequential(first, second)
