"""From a checkpoint to a model file that describes itself and has proved itself."""

import os

# See lanestream.inference.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
