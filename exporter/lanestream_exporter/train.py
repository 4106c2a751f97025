"""Training the classifier: rendered and real patches mixed, more real ones towards the end.

A run lives in a folder: `last.pt` to go on from, `best.pt` by validation, `curve.csv`. It can be stopped at any time
and goes on where it was.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from lanestream.errors import CheckpointError
from lanestream_exporter.alexnet import AlexNet, initialise, load_state, normalise
from lanestream_exporter.augment import augmented
from lanestream_exporter.patchstore import PatchStore


@dataclass(frozen=True)
class TrainSettings:
    """A run's settings; `real_share` of each batch is real, `final_real_share` of it in the last third."""

    steps: int = 1900
    batch: int = 96
    learning_rate: float = 3e-4
    weight_decay: float = 0.02
    warm_up: int = 100
    label_smoothing: float = 0.05
    real_share: float = 0.15
    final_real_share: float = 0.5
    check_every: int = 150
    seed: int = 1

    def share_at(self, step: int) -> float:
        """The share of real patches in the batch of `step`."""
        return self.real_share if step < self.steps * 2 // 3 else self.final_real_share

    def rate_at(self, step: int) -> float:
        """The learning rate of `step`: a warm-up, then half a cosine down to nothing."""
        rising = min(1.0, (step + 1) / self.warm_up)
        return self.learning_rate * rising * 0.5 * (1.0 + math.cos(math.pi * step / self.steps))


@dataclass(frozen=True)
class TrainData:
    """Patches to train on, and validation patches that choose the best checkpoint: rendered and real ones."""

    rendered: PatchStore
    real: PatchStore
    rendered_check: PatchStore
    real_check: PatchStore


@dataclass(frozen=True)
class Progress:
    """What is told after each step; the losses of the checks are None between checks."""

    step: int
    loss: float
    rendered_check: float | None = None
    real_check: float | None = None


class ClassifierTraining:
    """One run in `folder`; `weights` are torchvision's AlexNet to start from, where there are any."""

    def __init__(self, settings: TrainSettings, data: TrainData, folder: Path, weights: Path | None = None) -> None:
        torch.manual_seed(settings.seed)
        self._settings, self._data, self._folder = settings, data, folder
        self._network = AlexNet()
        if weights is not None:
            initialise(self._network, weights)
        self._optimiser = torch.optim.AdamW(self._network.parameters(), weight_decay=settings.weight_decay)
        self._step = 0
        self._best = math.inf
        folder.mkdir(parents=True, exist_ok=True)
        if self._last.exists():
            self._restore()

    @property
    def _last(self) -> Path:
        return self._folder / "last.pt"

    @property
    def best(self) -> Path:
        """The checkpoint that did best in validation."""
        return self._folder / "best.pt"

    def run(self, told: Callable[[Progress], None]) -> Path:
        """Trains to the end from wherever the run is; returns the best checkpoint's path."""
        settings = self._settings
        for patches, labels in self._batches():
            loss = self._learn(patches, labels)
            self._step += 1
            progress = Progress(self._step, loss)
            if self._step % settings.check_every == 0 or self._step == settings.steps:
                progress = self._check(loss)
                self._record(progress)
                self._save()
            told(progress)
        return self.best

    def _batches(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Batches from the current step on; the next one is decoded while the network works."""
        with ThreadPoolExecutor(1) as pool:
            steps = range(self._step, self._settings.steps)
            pending = pool.submit(self._batch, steps.start) if steps else None
            for step in steps:
                assert pending is not None  # noqa: S101 - there is a batch for every step
                ready = pending.result()
                pending = pool.submit(self._batch, step + 1) if step + 1 < steps.stop else None
                yield ready

    def _batch(self, step: int) -> tuple[Tensor, Tensor]:
        settings, data = self._settings, self._data
        rng = np.random.default_rng([settings.seed, step])
        real = round(settings.batch * settings.share_at(step))
        real_patches, real_labels = draw(data.real, real, rng)
        rendered_patches, rendered_labels = draw(data.rendered, settings.batch - real, rng)
        patches = torch.from_numpy(np.concatenate([real_patches, rendered_patches]))
        labels = torch.from_numpy(np.concatenate([real_labels, rendered_labels]))
        generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + step)
        return augmented(patches, generator), labels

    def _learn(self, patches: Tensor, labels: Tensor) -> float:
        self._network.train()
        for group in self._optimiser.param_groups:
            group["lr"] = self._settings.rate_at(self._step)
        with torch.autocast("cpu", torch.bfloat16):
            logits = self._network(normalise(patches))
        loss = functional.cross_entropy(logits.float(), labels, label_smoothing=self._settings.label_smoothing)
        self._optimiser.zero_grad()
        torch.autograd.backward(loss)
        self._optimiser.step()
        return loss.item()

    def _check(self, loss: float) -> Progress:
        """Measures both validation sets; keeps the network if their mean is the lowest so far."""
        rendered = log_loss(self._network, self._data.rendered_check)
        real = log_loss(self._network, self._data.real_check)
        if rendered + real < self._best:
            self._best = rendered + real
            _write(self.best, {"network": self._network.state_dict(), "step": self._step})
        return Progress(self._step, loss, rendered, real)

    def _record(self, progress: Progress) -> None:
        path = self._folder / "curve.csv"
        is_new = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(asdict(progress)))
            if is_new:
                writer.writeheader()
            writer.writerow(asdict(progress))

    def _save(self) -> None:
        state = {
            "network": self._network.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "step": self._step,
            "best": self._best,
        }
        _write(self._last, state)

    def _restore(self) -> None:
        state = read_checkpoint(self._last)
        self._network.load_state_dict(state["network"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._step, self._best = int(state["step"]), float(state["best"])


def draw(store: PatchStore, count: int, rng: np.random.Generator) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """`count` patches of a store, half of them true, and their labels."""
    chosen = [
        rng.choice(np.flatnonzero(store.labels == label), size)
        for label, size in ((1, count // 2), (0, count - count // 2))
    ]
    index = np.concatenate(chosen)
    return np.stack([store.patch(int(i)) for i in index]), store.labels[index]


@torch.inference_mode()
def scores(network: AlexNet, store: PatchStore, batch: int = 64) -> NDArray[np.float32]:
    """Logits (N, classes) of all patches of a store."""
    network.eval()
    parts = []
    for start in range(0, len(store), batch):
        patches = np.stack([store.patch(i) for i in range(start, min(start + batch, len(store)))])
        with torch.autocast("cpu", torch.bfloat16):
            parts.append(network(normalise(torch.from_numpy(patches))).float().numpy())
    return np.concatenate(parts)


def log_loss(network: AlexNet, store: PatchStore) -> float:
    """Mean cross entropy over a store, both classes weighing the same."""
    logits = torch.from_numpy(scores(network, store))
    losses = functional.cross_entropy(logits, torch.from_numpy(store.labels), reduction="none").numpy()
    return float(np.mean([losses[store.labels == label].mean() for label in (0, 1)]))


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint of this module. Raises CheckpointError with what to do about it."""
    state = load_state(path)
    if "network" not in state:
        raise CheckpointError(f"{path} is not a checkpoint of this trainer", "give the best.pt of a run")
    return state


def _write(path: Path, state: dict[str, Any]) -> None:
    """Saves whole or not at all, so that a run that is cut off can go on."""
    unfinished = path.with_suffix(".part")
    torch.save(state, unfinished)
    unfinished.replace(path)
