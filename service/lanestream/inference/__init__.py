"""Running networks: ONNX models that describe themselves, and the execution providers that run them."""

import os

# onnxruntime reports its use to Microsoft from its first import on, unless this is set. A user's own setting is kept.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
