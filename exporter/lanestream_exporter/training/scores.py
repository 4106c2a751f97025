"""What a classifier says of many patches."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from lanestream_exporter.alexnet import normalise
from lanestream_exporter.samples.patch_store import PatchStore
from lanestream_exporter.training.device import autocast


@torch.inference_mode()
def scores(network: nn.Module, store: PatchStore, batch: int = 64) -> NDArray[np.float32]:
    """Logits (N, classes) of all patches of a store."""
    network.eval()
    device = next(network.parameters()).device
    parts = []
    for start in range(0, len(store), batch):
        patches = np.stack([store.patch(i) for i in range(start, min(start + batch, len(store)))])
        with autocast(device):
            logits = network(normalise(torch.from_numpy(patches).to(device)))
        parts.append(logits.float().cpu().numpy())
    return np.concatenate(parts)
