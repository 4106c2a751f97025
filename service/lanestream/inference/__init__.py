"""Running networks: ONNX models that describe themselves, and the execution providers that run them."""

import os

# onnxruntime tells Microsoft what it runs, from its first import in the process on. Whoever set this has decided.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

from lanestream.inference.loaded_model import LoadedModel, Placement
from lanestream.inference.loading import load_model
from lanestream.inference.model_info import ClassifierInfo, ModelInfo, PatchInfo, RegressorInfo, RoadCropInfo
from lanestream.inference.onnx_model import OnnxModel
from lanestream.inference.openvino_model import OpenVinoModel

__all__ = [
    "ClassifierInfo",
    "LoadedModel",
    "ModelInfo",
    "OnnxModel",
    "OpenVinoModel",
    "PatchInfo",
    "Placement",
    "RegressorInfo",
    "RoadCropInfo",
    "load_model",
]
