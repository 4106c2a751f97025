"""Running networks: ONNX models that describe themselves, and the execution providers that run them."""

from lanestream.inference.model import OnnxModel
from lanestream.inference.model_info import ModelInfo, StripInfo

__all__ = ["ModelInfo", "OnnxModel", "StripInfo"]
