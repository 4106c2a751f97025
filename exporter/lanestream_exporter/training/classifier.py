"""The classifier's task: a mix of rendered and real patches, with more real ones towards the end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lanestream.errors import CheckpointError, LabelError
from lanestream.road.curve import FloatArray
from lanestream_exporter.alexnet import AlexNet, ClassifierLogits, load_torchvision_weights, normalize
from lanestream_exporter.samples.augment import augmented
from lanestream_exporter.samples.patch_files import PatchStore
from lanestream_exporter.samples.patches import NOT_KNOWN
from lanestream_exporter.samples.truth import MARKING, NOTHING, ROAD_EDGE
from lanestream_exporter.training.config import ClassifierConfig
from lanestream_exporter.training.data_sources import PatchSource
from lanestream_exporter.training.loop import SELECTED_BY, Batch, autocast
from lanestream_exporter.training.shipped import initial_weights
from lanestream_exporter.weight_files import load_state

# The share of each batch by what a patch shows; the rest are patches that show one of two kinds. A kind that a source
# lacks leaves its share to the others.
_KIND_SHARES: Final = {NOTHING: 0.42, MARKING: 0.38, ROAD_EDGE: 0.15}
_OTHER_SHARE: Final = 0.05
# The weights of the losses of type and color beside that of the kind, and of the errors of a patch among others.
_TYPE_WEIGHT, _COLOR_WEIGHT = 0.3, 0.2


class ClassifierTask:
    """Trains `network` to classify candidates, on a rendered or a real source, or on both.

    `origin` is recorded with the run: where the patches came from. Raises LabelError if no source has patches without a
    boundary to validate with.
    """

    def __init__(
        self, config: ClassifierConfig, network: AlexNet, sources: Sequence[PatchSource], origin: dict[str, Any]
    ) -> None:
        if not any(source.check.has_nothing for source in sources):
            raise LabelError("no patches without a boundary to validate with", "give more frames, or render scenes")
        self._config = config
        self._sources = {source.name: source for source in sources}
        self._drawn = {source.name: _cumulative_chances(source.train) for source in sources}
        self.network = network
        self.data: dict[str, Any] = {**origin, **{source.name: source.counts for source in sources}}

    def batch(self, step: int) -> Batch:
        """Returns augmented RGB patches (N, H, W, 3) uint8 and their targets (N, 3), as in `patches.Patches`."""
        config = self._config
        rng = np.random.default_rng([config.seed, step])
        share = config.data.real_share if step < config.steps * 2 // 3 else config.data.final_real_share
        real = round(config.batch * share)
        counts = [("real", real), ("rendered", config.batch - real)]
        samples = [self._draw(name, count, rng) for name, count in counts if count]
        patches, targets = (np.concatenate(parts) for parts in zip(*samples, strict=True))
        pixels = augmented(patches, targets[:, 0] != NOTHING, config.augmentation, rng)
        return torch.from_numpy(pixels), torch.from_numpy(targets.astype(np.int64))

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Returns the cross entropy of kind, type and color, with smoothed kinds."""
        patches, targets = batch
        # Convolutions on the CPU are faster with channels last.
        logits: Tensor = network(normalize(patches).contiguous(memory_format=torch.channels_last))
        return sum_of_losses(ClassifierLogits.of(logits.float()), targets, self._config.label_smoothing)

    def check(self, network: nn.Module) -> dict[str, float]:
        """Returns loss and accuracies of each source, each kind counting equally; the mean loss selects the network."""
        measured = {name: _check(network, source.check) for name, source in self._sources.items()}
        figures = {SELECTED_BY: sum(each["loss"] for each in measured.values()) / len(measured)}
        for name, values in measured.items():
            figures |= {f"{name}_{key}": value for key, value in values.items()}
        return figures

    def _draw(self, name: str, count: int, rng: np.random.Generator) -> tuple[NDArray[np.uint8], NDArray[np.int8]]:
        """Returns `count` random training patches of a source and their targets."""
        store, chances = self._sources[name].train, self._drawn[name]
        index = np.minimum(np.searchsorted(chances, rng.random(count), "right"), len(store) - 1)
        return np.stack([store.patch(int(i)) for i in index]), store.targets[index]


def starting_network(config: ClassifierConfig) -> AlexNet:
    """Returns the network before its first step: random by the seed, or with the weights of `initial`.

    `initial` is the checkpoint of a classifier run, `shipped`, or a torchvision AlexNet, of which the last layer is not
    used. Raises CheckpointError if the file is none of these.
    """
    torch.manual_seed(config.seed)
    network = AlexNet(shape=config.network.shape)
    if config.initial is None:
        return network
    weights = initial_weights(config.initial, "classifier")
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


def _cumulative_chances(store: PatchStore) -> FloatArray:
    """Returns the cumulative chances (N,) with which the patches of a store are drawn.

    Kinds have their shares. Within a kind, data sets, types and colors count by the square root of their numbers, so
    that none dominates and none is repeated too often.
    """
    kinds = store.targets[:, 0]
    weights = np.zeros(len(store))
    for kind in (*_KIND_SHARES, None):
        chosen = np.flatnonzero(kinds == kind if kind is not None else ~np.isin(kinds, list(_KIND_SHARES)))
        if len(chosen):
            own = _balanced(store.sets[chosen]) * _balanced(store.targets[chosen, 1] * 4 + store.targets[chosen, 2])
            weights[chosen] = (_OTHER_SHARE if kind is None else _KIND_SHARES[kind]) * own / own.sum()
    return np.asarray(np.cumsum(weights) / weights.sum())


def _balanced(groups: NDArray[np.integer[Any]]) -> FloatArray:
    """Returns weights (N,) by which each group counts by the square root of its size."""
    _, index, sizes = np.unique(groups, return_inverse=True, return_counts=True)
    return np.asarray(1.0 / np.sqrt(sizes[index]))


def sum_of_losses(logits: ClassifierLogits, targets: Tensor, smoothing: float = 0.0) -> Tensor:
    """Returns the mean loss of N patches with `targets` (N, 3), as in `patches.Patches`.

    The loss of the kind is the negative logarithm of the probability of all kinds that the patch may show. Types and
    colors count where they are known.
    """
    kind = (1.0 - smoothing) * kind_losses(logits.kinds, targets[:, 0])
    kind = kind - smoothing * functional.log_softmax(logits.kinds, dim=1).mean(dim=1)
    number = len(targets)
    types = functional.cross_entropy(logits.types, targets[:, 1], ignore_index=NOT_KNOWN, reduction="sum")
    colors = functional.cross_entropy(logits.colors, targets[:, 2], ignore_index=NOT_KNOWN, reduction="sum")
    # Divided by a fixed number: a batch with few markings must not weigh each of them more.
    return kind.mean() + (_TYPE_WEIGHT * types + _COLOR_WEIGHT * colors) / (_KIND_SHARES[MARKING] * number)


def kind_losses(logits: Tensor, allowed: Tensor) -> Tensor:
    """Returns the negative logarithms (N,) of the probabilities of the `allowed` kinds, bits of `truth`."""
    is_allowed = (allowed[:, None] & torch.tensor((NOTHING, MARKING, ROAD_EDGE), device=allowed.device)) != 0
    chosen = torch.where(is_allowed, functional.log_softmax(logits, dim=1), -torch.inf)
    return -torch.logsumexp(chosen, dim=1)


@torch.inference_mode()
def patch_logits(network: nn.Module, store: PatchStore, batch: int = 64) -> Tensor:
    """Returns logits (N, outputs) of all patches of a store."""
    network.eval()
    device = next(network.parameters()).device
    parts = []
    for start in range(0, len(store), batch):
        patches = np.stack([store.patch(i) for i in range(start, min(start + batch, len(store)))])
        with autocast(device):
            logits = network(normalize(torch.from_numpy(patches).to(device)))
        parts.append(logits.float().cpu())
    return torch.cat(parts)


def _check(network: nn.Module, store: PatchStore) -> dict[str, float]:
    """Returns loss and accuracy of the kinds, each counting equally, and accuracies of types and colors.

    Boundaries of unknown kind count as one more.
    """
    logits, targets = (
        ClassifierLogits.of(patch_logits(network, store)),
        torch.from_numpy(store.targets.astype(np.int64)),
    )
    losses, predicted = kind_losses(logits.kinds, targets[:, 0]), logits.kinds.argmax(dim=1)
    right = (targets[:, 0] & torch.tensor((NOTHING, MARKING, ROAD_EDGE))[predicted] != 0).float()
    groups = [targets[:, 0] == kind for kind in (NOTHING, MARKING, ROAD_EDGE, MARKING | ROAD_EDGE)]
    present = [chosen for chosen in groups if chosen.any()]
    figures = {
        "loss": float(np.mean([float(losses[chosen].mean()) for chosen in present])),
        "accuracy": float(np.mean([float(right[chosen].mean()) for chosen in present])),
    }
    for name, values, column, weight in (
        ("type", logits.types, targets[:, 1], _TYPE_WEIGHT),
        ("color", logits.colors, targets[:, 2], _COLOR_WEIGHT),
    ):
        known = column != NOT_KNOWN
        if known.any():
            figures["loss"] += weight * float(functional.cross_entropy(values[known], column[known]))
            figures[f"{name}_accuracy"] = float((values[known].argmax(dim=1) == column[known]).float().mean())
    return figures
