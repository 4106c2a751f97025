"""Training: what a run is told, the loop that every network learns in, and what the networks are trained for."""

from lanestream_exporter.training.checkpoints import read_checkpoint
from lanestream_exporter.training.classifier import scores

__all__ = ["read_checkpoint", "scores"]
