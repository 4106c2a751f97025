"""The shipped networks as checkpoints that training can start from: with normalization layers, in half precision."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, Literal

import torch

from lanestream_exporter.training.run_files import read_checkpoint, write_checkpoint

Network = Literal["classifier", "regressor"]

# The value of `initial` that stands for the shipped checkpoint.
SHIPPED: Final = "shipped"
_FOLDER: Final = Path(__file__).parent.parent / "checkpoints"


def initial_weights(initial: str, network: Network) -> Path:
    """Returns the checkpoint that `initial` names: a path, or "shipped" for that of the shipped `network`."""
    return _FOLDER / f"{network}.pt" if initial == SHIPPED else Path(initial)


def write_half(source: Path, out: Path) -> None:
    """Writes the weights and the record of the checkpoint `source` to `out`, in half precision.

    Half precision changes outputs by a thousandth, far less than a step of training. Raises CheckpointError for files
    that are not checkpoints of a run.
    """
    state = read_checkpoint(source)
    network: dict[str, Any] = {
        key: value.half() if torch.is_floating_point(value) else value for key, value in state["network"].items()
    }
    kept: dict[str, Any] = {key: state[key] for key in ("step", "figures", "record") if key in state}
    write_checkpoint(out, {"network": network, **kept})
