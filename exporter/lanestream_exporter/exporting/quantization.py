"""Static int8: weights and activations in eight bits, ranges from real inputs, by onnxruntime's own tool."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

# The layers that hold the weights and the time; what prepares the inputs before them stays exact.
_QUANTIZED: Final = ["Conv", "Gemm", "MatMul", "MaxPool", "Relu"]


class _Inputs(CalibrationDataReader):  # type: ignore[misc]  # onnxruntime ships no types
    """Feeds inputs to the calibrator, a few at a time."""

    def __init__(self, name: str, inputs: NDArray[np.uint8], batch: int = 16) -> None:
        self._name = name
        self._batches = iter([inputs[i : i + batch] for i in range(0, len(inputs), batch)])

    def get_next(self) -> dict[str, Any] | None:
        batch = next(self._batches, None)
        return None if batch is None else {self._name: batch}


def quantized(source: Path, path: Path, inputs: NDArray[np.uint8], exact: Sequence[str] = ()) -> None:
    """Writes the fp32 model file `source` as an int8 one to `path`, its ranges from RGB `inputs` (N, H, W, 3) uint8.

    Layers with a weight whose name begins with one of `exact` stay as they are.
    """
    prepared = path.with_suffix(".prepared.onnx")
    with _quiet():
        quant_pre_process(str(source), str(prepared), skip_symbolic_shape=True)
        model = onnx.load(str(prepared))
        kept = [node.name for node in model.graph.node if any(name.startswith(tuple(exact)) for name in node.input)]
        quantize_static(
            str(prepared),
            str(path),
            _Inputs(model.graph.input[0].name, inputs),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=_QUANTIZED,
            nodes_to_exclude=kept,
            per_channel=True,
            # Weights in seven bits: processors without VNNI add two products in sixteen bits, and cut off what is more.
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            calibrate_method=CalibrationMethod.MinMax,
            extra_options={"CalibMovingAverage": True},
        )
    onnx.checker.check_model(str(path))


@contextmanager
def _quiet() -> Iterator[None]:
    """Its advice to prepare the model first is given whether or not that was done."""
    root = logging.getLogger()
    before = root.level
    root.setLevel(logging.ERROR)
    try:
        yield
    finally:
        root.setLevel(before)
