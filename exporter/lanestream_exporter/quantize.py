"""Static int8: weights and activations in eight bits, ranges from real patches, by onnxruntime's own tool."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

# The layers that hold the weights and the time; what prepares the patches before them stays exact.
_QUANTIZED = ["Conv", "Gemm", "MatMul", "MaxPool", "Relu"]


class _Patches(CalibrationDataReader):  # type: ignore[misc]  # onnxruntime ships no types
    """Feeds patches to the calibrator, a few at a time."""

    def __init__(self, patches: NDArray[np.uint8], batch: int = 16) -> None:
        self._batches = iter([patches[i : i + batch] for i in range(0, len(patches), batch)])

    def get_next(self) -> dict[str, Any] | None:
        batch = next(self._batches, None)
        return None if batch is None else {"patches": batch}


def quantized(path: Path, patches: NDArray[np.uint8]) -> None:
    """Makes the fp32 model file at `path` an int8 one, its ranges from RGB `patches` (N, H, W, 3) uint8."""
    prepared = path.with_suffix(".prepared.onnx")
    quant_pre_process(str(path), str(prepared), skip_symbolic_shape=True)
    # Its advice to prepare the model first is given whether or not that was done.
    logging.getLogger().setLevel(logging.ERROR)
    quantize_static(
        str(prepared),
        str(path),
        _Patches(patches),
        quant_format=QuantFormat.QDQ,
        op_types_to_quantize=_QUANTIZED,
        per_channel=True,
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
        calibrate_method=CalibrationMethod.MinMax,
        extra_options={"CalibMovingAverage": True},
    )
    onnx.checker.check_model(str(path))
