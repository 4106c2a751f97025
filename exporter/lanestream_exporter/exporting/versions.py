"""Which versions wrote a file."""

from __future__ import annotations

from importlib.metadata import version

import onnxruntime
import torch


def product() -> str:
    """The version of this program, and so of the models that it writes."""
    return version("lanestream")


def exporter() -> str:
    """What wrote the file."""
    return f"lanestream {product()}, torch {torch.__version__}, onnxruntime {onnxruntime.__version__}"
