"""Compression: low-rank truncation of the fully connected layers, and static int8 quantization.

The fully connected layers hold 54 of AlexNet's 57 million weights, and need only a fraction of them.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process
from torch import Tensor, nn

_BATCH = 32

# These layers hold the weights and take the time. The input normalization in front of them stays in fp32.
_QUANTIZED_OPS: Final = ["Conv", "Gemm", "MatMul", "MaxPool", "Relu"]


@torch.inference_mode()
def truncate_layers(layers: nn.Sequential, x: Tensor, energy: float) -> nn.Sequential:
    """Returns a copy whose hidden linear layers keep the share `energy` of the variance of their outputs.

    `x` (N, in) are inputs of the first of `layers`, from road images: what counts is the variance of the responses to
    roads, not the variance that the weights could produce for any input, most of which is initialization noise. Each
    linear layer except a final one becomes two thinner ones in sequence if that saves weights; 1.0 keeps all layers.
    Source: X. Zhang et al., "Accelerating very deep convolutional networks", 2015, section 3.1 (principal components
    of responses).
    """
    small = copy.deepcopy(layers).eval()
    if energy >= 1.0:
        return small
    for index, layer in enumerate(list(small)[:-1]):
        y = layer(x)
        if isinstance(layer, nn.Linear):
            small[index] = _factorized(layer, y, energy)
        x = y
    return small


@torch.inference_mode()
def in_batches(function: Callable[[Tensor], Tensor], inputs: NDArray[np.uint8]) -> Tensor:
    """Applies `function` to RGB inputs (N, H, W, 3) uint8 in batches and returns all results."""
    batches = (torch.from_numpy(inputs[start : start + _BATCH]) for start in range(0, len(inputs), _BATCH))
    return torch.cat([function(batch) for batch in batches])


def run_in_pytorch(module: nn.Module) -> Callable[[NDArray[np.uint8]], NDArray[np.float32]]:
    """Returns a function that runs `module` on RGB inputs (N, H, W, 3) uint8."""
    return lambda inputs: np.asarray(in_batches(module, inputs).numpy(), dtype=np.float32)


def _factorized(layer: nn.Linear, outputs: Tensor, energy: float) -> nn.Module:
    """Returns two layers that reproduce `outputs` (N, out) of `layer` in their strongest principal components.

    A rotation mixes the components that pass between the two layers. Without it the first components would be so much
    larger than the others that the eight bits, which all of them share, could not resolve the others.
    """
    mean = outputs.mean(dim=0)
    centered = outputs - mean
    # N outputs have at most N components: their Gram matrix is smaller than the covariance of the layer.
    values, vectors = torch.linalg.eigh(centered @ centered.T)
    values, vectors = values.flip(0).clamp(min=0.0), vectors.flip(1)
    cumulative = torch.cumsum(values, 0) / values.sum()
    rank = min(int(torch.searchsorted(cumulative, energy).item()) + 1, len(values))
    if rank * (layer.in_features + layer.out_features) >= layer.in_features * layer.out_features:
        return layer
    directions = centered.T @ vectors[:, :rank] / values[:rank].sqrt() @ _rotation(rank)
    first = nn.Linear(layer.in_features, rank, bias=False)
    second = nn.Linear(rank, layer.out_features)
    first.weight.data = directions.T @ layer.weight
    second.weight.data = directions
    second.bias.data = mean + directions @ (directions.T @ (layer.bias - mean))
    return nn.Sequential(first, second)


def _rotation(size: int) -> Tensor:
    """Returns a random orthogonal matrix (size, size), the same in every run."""
    rotation: Tensor = torch.linalg.qr(torch.randn(size, size, generator=torch.Generator().manual_seed(0))).Q
    return rotation


class _BatchReader(CalibrationDataReader):  # type: ignore[misc]  # onnxruntime ships no types
    """Feeds inputs to onnxruntime's calibrator in batches."""

    def __init__(self, name: str, inputs: NDArray[np.uint8], batch: int = 16) -> None:
        self._name = name
        self._batches = iter([inputs[i : i + batch] for i in range(0, len(inputs), batch)])

    def get_next(self) -> dict[str, Any] | None:
        batch = next(self._batches, None)
        return None if batch is None else {self._name: batch}


def quantize(source: Path, path: Path, inputs: NDArray[np.uint8], fp32_layers: Sequence[str] = ()) -> None:
    """Quantizes the fp32 file `source` to int8 and writes it to `path`; `inputs` (N, H, W, 3) uint8 set the ranges.

    Layers with a weight whose name starts with one of `fp32_layers` are not quantized.
    """
    prepared = path.with_suffix(".prepared.onnx")
    with _quiet_logging():
        quant_pre_process(str(source), str(prepared), skip_symbolic_shape=True)
        model = onnx.load(str(prepared))
        excluded = [n.name for n in model.graph.node if any(name.startswith(tuple(fp32_layers)) for name in n.input)]
        quantize_static(
            str(prepared),
            str(path),
            _BatchReader(model.graph.input[0].name, inputs),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=_QUANTIZED_OPS,
            nodes_to_exclude=excluded,
            per_channel=True,
            # Seven-bit weights: processors without VNNI add two products in sixteen bits and saturate larger sums.
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            calibrate_method=CalibrationMethod.MinMax,
            extra_options={"CalibMovingAverage": True},
        )
    onnx.checker.check_model(str(path))


@contextmanager
def _quiet_logging() -> Iterator[None]:
    """Silences onnxruntime's advice to preprocess the model, which it logs even after preprocessing."""
    root = logging.getLogger()
    level = root.level
    root.setLevel(logging.ERROR)
    try:
        yield
    finally:
        root.setLevel(level)
