"""The classifier's task: a mix of rendered and real patches, with more real ones towards the end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lanestream.errors import CheckpointError
from lanestream_exporter.alexnet import AlexNet, load_state, load_torchvision_weights, normalize
from lanestream_exporter.samples.augment import augmented
from lanestream_exporter.samples.patch_files import PatchStore
from lanestream_exporter.training.config import ClassifierConfig
from lanestream_exporter.training.data_sources import PatchSource
from lanestream_exporter.training.loop import SELECTED_BY, Batch, autocast


class ClassifierTask:
    """Trains `network` to separate true candidates from false ones, on a rendered or a real source, or on both.

    `origin` is recorded with the run: where the patches came from.
    """

    def __init__(
        self, config: ClassifierConfig, network: AlexNet, sources: Sequence[PatchSource], origin: dict[str, Any]
    ) -> None:
        self._config = config
        self._sources = {source.name: source for source in sources}
        self.network = network
        self.data: dict[str, Any] = {**origin, **{source.name: source.counts for source in sources}}

    def batch(self, step: int) -> Batch:
        """Returns augmented RGB patches (N, H, W, 3) uint8 and their labels (N,)."""
        config = self._config
        rng = np.random.default_rng([config.seed, step])
        share = config.data.real_share if step < config.steps * 2 // 3 else config.data.final_real_share
        real = round(config.batch * share)
        counts = [("real", real), ("rendered", config.batch - real)]
        samples = [draw_patches(self._sources[name], count, rng) for name, count in counts if count]
        patches, labels = (np.concatenate(parts) for parts in zip(*samples, strict=True))
        return torch.from_numpy(augmented(patches, labels, config.augmentation, rng)), torch.from_numpy(labels)

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Returns the cross entropy with smoothed labels."""
        patches, labels = batch
        # Convolutions on the CPU are faster with channels last.
        logits: Tensor = network(normalize(patches).contiguous(memory_format=torch.channels_last))
        return functional.cross_entropy(logits.float(), labels, label_smoothing=self._config.label_smoothing)

    def check(self, network: nn.Module) -> dict[str, float]:
        """Returns loss and accuracy of each source, with equal class weights; the mean loss selects the network."""
        measured = {name: _loss_and_accuracy(network, source.check) for name, source in self._sources.items()}
        figures = {SELECTED_BY: sum(loss for loss, _ in measured.values()) / len(measured)}
        for name, (loss, accuracy) in measured.items():
            figures |= {f"{name}_loss": loss, f"{name}_accuracy": accuracy}
        return figures


def starting_network(config: ClassifierConfig) -> AlexNet:
    """Returns the network before its first step: random by the seed, or with the weights of `initial`.

    `initial` is the checkpoint of a classifier run, or a torchvision AlexNet, of which the last layer is not used.
    Raises CheckpointError if the file is neither.
    """
    torch.manual_seed(config.seed)
    network = AlexNet(shape=config.network.shape)
    if config.initial is None:
        return network
    weights = Path(config.initial)
    state = load_state(weights)
    if "network" not in state:
        load_torchvision_weights(network, weights)
        return network
    try:
        network.load_state_dict(state["network"])
    except (RuntimeError, TypeError, AttributeError) as error:
        hint = "give the best.pt of a classifier run, or torchvision's alexnet weights"
        raise CheckpointError(f"{weights} holds another network", hint) from error
    return network


def draw_patches(
    source: PatchSource, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Returns `count` random training patches of a source, half of them true, and their labels."""
    store = source.train
    chosen = [
        rng.choice(np.flatnonzero(store.labels == label), size)
        for label, size in ((1, count // 2), (0, count - count // 2))
    ]
    index = np.concatenate(chosen)
    return np.stack([store.patch(int(i)) for i in index]), store.labels[index]


@torch.inference_mode()
def patch_logits(network: nn.Module, store: PatchStore, batch: int = 64) -> NDArray[np.float32]:
    """Returns logits (N, classes) of all patches of a store."""
    network.eval()
    device = next(network.parameters()).device
    parts = []
    for start in range(0, len(store), batch):
        patches = np.stack([store.patch(i) for i in range(start, min(start + batch, len(store)))])
        with autocast(device):
            logits = network(normalize(torch.from_numpy(patches).to(device)))
        parts.append(logits.float().cpu().numpy())
    return np.concatenate(parts)


def _loss_and_accuracy(network: nn.Module, store: PatchStore) -> tuple[float, float]:
    """Returns mean cross entropy and accuracy over a store, with equal class weights."""
    logits = patch_logits(network, store)
    losses = functional.cross_entropy(
        torch.from_numpy(logits), torch.from_numpy(store.labels), reduction="none"
    ).numpy()
    correct = logits.argmax(axis=1) == store.labels
    classes = [store.labels == label for label in (0, 1)]
    return tuple(float(np.mean([values[chosen].mean() for chosen in classes])) for values in (losses, correct))  # type: ignore[return-value]
