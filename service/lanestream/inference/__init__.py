"""Running networks: ONNX models that describe themselves, and the execution providers that run them."""

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
