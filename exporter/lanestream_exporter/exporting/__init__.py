"""Exports a checkpoint to an ONNX file that describes itself and is verified against PyTorch."""

import os

# See lanestream.inference.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
