"""Running networks: ONNX models that describe themselves, and the execution providers that run them."""

from lanestream.inference.model import OnnxModel
from lanestream.inference.model_info import CanvasInfo, ClassifierInfo, ModelInfo, RegressorInfo, StripInfo

__all__ = ["CanvasInfo", "ClassifierInfo", "ModelInfo", "OnnxModel", "RegressorInfo", "StripInfo"]
