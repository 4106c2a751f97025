"""The loop that every network learns in: seeded, resumable, with the best network by validation kept.

A run lives in a folder: `last.pt` to go on from, `best.pt` by validation, `curve.csv` and `curve.png`. Every step is
seeded by its number, so that a run that was stopped and goes on is the same run as one that was not.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from lanestream.errors import SettingsError
from lanestream.host import processors
from lanestream_exporter.alexnet import load_state
from lanestream_exporter.training.average import WeightAverage
from lanestream_exporter.training.checkpoints import made_by, write_checkpoint
from lanestream_exporter.training.config import Cosine, Sgd, TrainConfig
from lanestream_exporter.training.curve import Row, write_curve
from lanestream_exporter.training.device import autocast, best_device

Batch = tuple[Tensor, ...]

# The figure of `Task.check` that chooses the best network: the lower, the better.
CHOOSES = "validation"

_MOST_WORKERS = 8


class Task(Protocol):
    """What a network is trained for. The loop calls `loss` and `check` in the precision of the device."""

    @property
    def network(self) -> nn.Module:
        """The network with the weights to start from."""

    @property
    def data(self) -> dict[str, Any]:
        """What it is trained on, in plain types, for the checkpoint: counts and sources."""

    def batch(self, step: int) -> Batch:
        """The batch of a step on the CPU, the same at every call; called in other threads."""

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """The float32 loss of a batch on the network's device."""

    def check(self, network: nn.Module) -> dict[str, float]:
        """The figures of validation; `validation` chooses the best network, the lower the better."""


@dataclass(frozen=True)
class Progress:
    """What is told after each step; `figures` are those of a check, empty between checks."""

    step: int
    loss: float
    figures: Row = field(default_factory=dict)


class Run:
    """A run of `task` in `folder`, from wherever it was left.

    Raises SettingsError where the folder holds a run of another configuration or other data, CheckpointError where
    what it holds can't be read.
    """

    def __init__(self, task: Task, config: TrainConfig, folder: Path) -> None:
        self._task, self._config, self._folder = task, config, folder
        self._device = best_device()
        self._network = task.network.to(self._device)
        self._optimiser = _optimiser(config, self._network)
        self._average = WeightAverage(self._network, config.ema) if config.ema else None
        self._record = {"config": config.recorded, "data": task.data, **made_by()}
        self._best = math.inf
        self._losses: list[float] = []
        self._rows: list[Row] = []
        self.step = 0
        folder.mkdir(parents=True, exist_ok=True)
        if self._last.exists():
            self._restore(load_state(self._last))

    @property
    def best(self) -> Path:
        """The checkpoint that did best in validation."""
        return self._folder / "best.pt"

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do."""
        return self.step >= self._config.steps

    @property
    def _last(self) -> Path:
        return self._folder / "last.pt"

    def go(self, told: Callable[[Progress], None], stopped: Callable[[], bool]) -> None:
        """Trains to the end, or until `stopped` says so after a step: then the run is saved and can go on."""
        for batch in self._batches():
            loss = self._learn(batch)
            self._losses.append(loss)
            self.step += 1
            is_due = self.step % self._config.check_every == 0 or self.finished
            told(Progress(self.step, loss, self._check() if is_due else {}))
            if is_due or stopped():
                self._save()
            if stopped():
                break

    def _batches(self) -> Iterator[Batch]:
        """Batches from the current step on; the next ones are prepared while the network works."""
        workers = 1 if self._device.type == "cpu" else min(_MOST_WORKERS, processors())
        coming: deque[Future[Batch]] = deque()
        with ThreadPoolExecutor(workers) as pool:
            try:
                for step in range(self.step, self._config.steps + workers):
                    if step < self._config.steps:
                        coming.append(pool.submit(self._task.batch, step))
                    if step >= self.step + workers and coming:
                        yield coming.popleft().result()
            finally:
                for future in coming:
                    future.cancel()

    def _learn(self, batch: Batch) -> float:
        torch.manual_seed(self._config.seed * 1_000_003 + self.step)  # of the network's own dice: dropout
        self._network.train()
        for group in self._optimiser.param_groups:
            group["lr"] = rate_at(self._config, self.step)
        with autocast(self._device):
            loss = self._task.loss(self._network, tuple(part.to(self._device) for part in batch))
        self._optimiser.zero_grad()
        torch.autograd.backward(loss)
        if self._config.clip:
            nn.utils.clip_grad_norm_(self._network.parameters(), self._config.clip)
        self._optimiser.step()
        if self._average is not None:
            self._average.update(self._network)
        value = loss.item()
        if not math.isfinite(value):
            raise SettingsError(f"the loss is no number any more at step {self.step + 1}", "lower the learning rate")
        return value

    @torch.inference_mode()
    def _check(self) -> Row:
        """Measures the network; keeps it if it is the best so far."""
        network = self._average.network if self._average is not None else self._network
        with autocast(self._device):
            figures = self._task.check(network.eval())
        loss = sum(self._losses) / len(self._losses)
        self._losses.clear()
        rate = rate_at(self._config, self.step - 1)
        self._rows.append({"step": self.step, "rate": rate, "loss": loss, **figures})
        write_curve(self._folder, self._rows)
        if figures[CHOOSES] < self._best:
            self._best = figures[CHOOSES]
            state = {"network": _on_cpu(network), "step": self.step, "figures": figures, "record": self._record}
            write_checkpoint(self.best, state)
        return figures

    def _save(self) -> None:
        """Keeps what the run goes on from; of a finished one only that it is."""
        state = {"step": self.step, "best": self._best, "rows": self._rows, "record": self._record}
        if not self.finished:
            state["network"] = self._network.state_dict()
            state["optimiser"] = self._optimiser.state_dict()
            state["average"] = self._average.state() if self._average is not None else None
            state["losses"] = self._losses
        write_checkpoint(self._last, state)

    def _restore(self, state: dict[str, Any]) -> None:
        self._refuse_another(state["record"])
        self.step, self._best, self._rows = int(state["step"]), float(state["best"]), state["rows"]
        if not self.finished:
            self._network.load_state_dict(state["network"])
            self._optimiser.load_state_dict(state["optimiser"])
            self._losses = state["losses"]
            if self._average is not None:
                self._average.restore(state["average"])

    def _refuse_another(self, record: dict[str, Any]) -> None:
        for part in ("config", "data"):
            was, now = record[part], self._record[part]
            different = sorted(key for key in was.keys() | now.keys() if was.get(key) != now.get(key))
            if different:
                raise SettingsError(
                    f"{self._folder} holds a run of another {part}: {different[0]} was {was.get(different[0])}",
                    "give a new folder with --run, or go on with what that run was started with",
                )


def rate_at(config: TrainConfig, step: int) -> float:
    """The learning rate of `step`, from 0."""
    schedule, rate = config.schedule, config.optimiser.learning_rate
    if isinstance(schedule, Cosine):
        rising = min(1.0, (step + 1) / schedule.warm_up) if schedule.warm_up else 1.0
        return rate * rising * 0.5 * (1.0 + math.cos(math.pi * step / config.steps))
    return float(rate * schedule.factor ** (step // schedule.every))


def _optimiser(config: TrainConfig, network: nn.Module) -> torch.optim.Optimizer:
    settings = config.optimiser
    if isinstance(settings, Sgd):
        return torch.optim.SGD(
            network.parameters(),
            settings.learning_rate,
            settings.momentum,
            weight_decay=settings.weight_decay,
            fused=True,
        )
    return torch.optim.AdamW(
        network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay, fused=True
    )


def _on_cpu(network: nn.Module) -> dict[str, Tensor]:
    return {key: value.cpu() for key, value in network.state_dict().items()}
