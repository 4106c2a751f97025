"""Which versions wrote a file."""

from __future__ import annotations

import onnxruntime
import torch

from lanestream import __version__


def exporter() -> str:
    """What wrote the file."""
    return f"lanestream {__version__}, torch {torch.__version__}, onnxruntime {onnxruntime.__version__}"
