"""Running networks: ONNX models that describe themselves, and the execution providers that run them."""

import os

# onnxruntime tells Microsoft what it runs, from its first import in the process on. Whoever set this has decided.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

from lanestream.inference.loading import load_network
from lanestream.inference.model import OnnxModel
from lanestream.inference.model_info import CanvasInfo, ClassifierInfo, ModelInfo, RegressorInfo, StripInfo
from lanestream.inference.network import LoadedNetwork, Placement
from lanestream.inference.openvino_model import OpenVinoModel

__all__ = [
    "CanvasInfo",
    "ClassifierInfo",
    "LoadedNetwork",
    "ModelInfo",
    "OnnxModel",
    "OpenVinoModel",
    "Placement",
    "RegressorInfo",
    "StripInfo",
    "load_network",
]
