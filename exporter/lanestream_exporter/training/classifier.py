"""The classifier's task: rendered and real patches mixed, more real ones towards the end."""

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
from lanestream_exporter.alexnet import AlexNet, initialise, load_state, normalise
from lanestream_exporter.samples.augment import augmented
from lanestream_exporter.samples.patch_store import PatchStore
from lanestream_exporter.training.config import ClassifierConfig
from lanestream_exporter.training.loop import CHOOSES, Batch
from lanestream_exporter.training.patchfiles import PatchSource
from lanestream_exporter.training.scores import scores


class ClassifierTask:
    """Teaches `network` to tell true candidates from false ones, by one source or by a rendered and a real one.

    `origin` is what to remember of where the patches came from.
    """

    def __init__(
        self, config: ClassifierConfig, network: AlexNet, sources: Sequence[PatchSource], origin: dict[str, Any]
    ) -> None:
        self._config = config
        self._sources = {source.name: source for source in sources}
        self.network = network
        self.data: dict[str, Any] = {**origin, **{source.name: source.counts for source in sources}}

    def batch(self, step: int) -> Batch:
        """RGB patches (N, H, W, 3) uint8 after augmentation, and their labels (N,)."""
        config = self._config
        rng = np.random.default_rng([config.seed, step])
        share = config.data.real_share if step < config.steps * 2 // 3 else config.data.final_real_share
        real = round(config.batch * share)
        wanted = [("real", real), ("rendered", config.batch - real)]
        drawn = [draw(self._sources[name], count, rng) for name, count in wanted if count]
        patches, labels = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
        return torch.from_numpy(augmented(patches, labels, config.augmentation, rng)), torch.from_numpy(labels)

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """The cross entropy, with smoothed labels."""
        patches, labels = batch
        # Convolutions on the CPU are faster with the channels last.
        logits: Tensor = network(normalise(patches).contiguous(memory_format=torch.channels_last))
        return functional.cross_entropy(logits.float(), labels, label_smoothing=self._config.label_smoothing)

    def check(self, network: nn.Module) -> dict[str, float]:
        """Loss and accuracy of each source, both classes weighing the same; the mean loss chooses."""
        measured = {name: _measured(network, source.check) for name, source in self._sources.items()}
        figures = {CHOOSES: sum(loss for loss, _ in measured.values()) / len(measured)}
        for name, (loss, accuracy) in measured.items():
            figures |= {f"{name}_loss": loss, f"{name}_accuracy": accuracy}
        return figures


def starting_network(config: ClassifierConfig) -> AlexNet:
    """The network before its first step: by the seed, or with the weights of `initial`.

    Those are all weights of a run's checkpoint, or the hidden layers of a torchvision AlexNet. Raises CheckpointError
    where the file is neither.
    """
    torch.manual_seed(config.seed)
    network = AlexNet(shape=config.network.shape)
    if config.initial is None:
        return network
    weights = Path(config.initial)
    state = load_state(weights)
    if "network" not in state:
        initialise(network, weights)
        return network
    try:
        network.load_state_dict(state["network"])
    except (RuntimeError, TypeError, AttributeError) as error:
        hint = "give the best.pt of a classifier's run, or torchvision's alexnet weights"
        raise CheckpointError(f"{weights} holds another network", hint) from error
    return network


def draw(source: PatchSource, count: int, rng: np.random.Generator) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """`count` patches of a source to train on, half of them true, and their labels."""
    store = source.train
    chosen = [
        rng.choice(np.flatnonzero(store.labels == label), size)
        for label, size in ((1, count // 2), (0, count - count // 2))
    ]
    index = np.concatenate(chosen)
    return np.stack([store.patch(int(i)) for i in index]), store.labels[index]


def _measured(network: nn.Module, store: PatchStore) -> tuple[float, float]:
    """Mean cross entropy and accuracy over a store, both classes weighing the same."""
    logits = scores(network, store)
    losses = functional.cross_entropy(
        torch.from_numpy(logits), torch.from_numpy(store.labels), reduction="none"
    ).numpy()
    right = logits.argmax(axis=1) == store.labels
    classes = [store.labels == label for label in (0, 1)]
    return tuple(float(np.mean([values[chosen].mean() for chosen in classes])) for values in (losses, right))  # type: ignore[return-value]
