"""Making AlexNet small: its fully connected layers hold 54 of its 57 million weights, and need few of them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

_BATCH = 32


@torch.inference_mode()
def truncated(layers: nn.Sequential, x: Tensor, energy: float) -> nn.Sequential:
    """A copy whose hidden linear layers keep the directions that hold the share `energy` of their outputs' variance.

    `x` (N, in) is what roads give the first of `layers`: the variance is that of what the layers do to roads, not of
    what their weights could do to anything, most of which is the noise they were initialised with. Each linear layer
    but a last one becomes two thinner ones in a row, where that saves weights; 1.0 keeps them as they are. Source:
    X. Zhang et al., "Accelerating very deep convolutional networks", 2015, section 3.1 (principal components of
    responses).
    """
    small = copy.deepcopy(layers).eval()
    if energy >= 1.0:
        return small
    for index, layer in enumerate(list(small)[:-1]):
        y = layer(x)
        if isinstance(layer, nn.Linear):
            small[index] = _factored(layer, y, energy)
        x = y
    return small


@torch.inference_mode()
def in_batches(function: Callable[[Tensor], Tensor], inputs: NDArray[np.uint8]) -> Tensor:
    """What `function` makes of RGB inputs (N, H, W, 3) uint8, a few at a time."""
    return torch.cat([function(part) for part in _parts(inputs)])


def _parts(inputs: NDArray[np.uint8]) -> Iterator[Tensor]:
    for start in range(0, len(inputs), _BATCH):
        yield torch.from_numpy(inputs[start : start + _BATCH])


def _factored(layer: nn.Linear, outputs: Tensor, energy: float) -> nn.Module:
    """Two layers that reproduce `outputs` (N, out) of `layer` in their strongest principal components.

    What goes from one to the other is the components mixed by a rotation: alone the first ones would be so much larger
    than the others that eight bits, which all of them share, could not tell the others from nothing.
    """
    mean = outputs.mean(dim=0)
    centred = outputs - mean
    # Of N outputs there are at most N components: their Gram matrix is smaller than the layer's covariance.
    values, vectors = torch.linalg.eigh(centred @ centred.T)
    values, vectors = values.flip(0).clamp(min=0.0), vectors.flip(1)
    held = torch.cumsum(values, 0) / values.sum()
    rank = min(int(torch.searchsorted(held, energy).item()) + 1, len(values))
    if rank * (layer.in_features + layer.out_features) >= layer.in_features * layer.out_features:
        return layer
    directions = centred.T @ vectors[:, :rank] / values[:rank].sqrt() @ _rotation(rank)
    first = nn.Linear(layer.in_features, rank, bias=False)
    second = nn.Linear(rank, layer.out_features)
    first.weight.data = directions.T @ layer.weight
    second.weight.data = directions
    second.bias.data = mean + directions @ (directions.T @ (layer.bias - mean))
    return nn.Sequential(first, second)


def _rotation(size: int) -> Tensor:
    """An orthogonal matrix (size, size), random and always the same."""
    rotation: Tensor = torch.linalg.qr(torch.randn(size, size, generator=torch.Generator().manual_seed(0))).Q
    return rotation
