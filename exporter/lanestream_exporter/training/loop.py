"""The training loop of all networks: seeded and resumable. It keeps the network with the best validation figures.

A run has a folder: `last.pt` to resume from, `best.pt` by validation, `curve.csv` and `curve.png`. Every step is seeded
by its number, so a run that is stopped and resumed gives the same result as one that is not.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import cv2
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from lanestream.errors import SettingsError
from lanestream.host import processors
from lanestream_exporter.training.config import Cosine, Sgd, TrainConfig
from lanestream_exporter.training.run_files import CurveRow, made_by, write_checkpoint, write_curve
from lanestream_exporter.weight_files import load_state

Batch = tuple[Tensor, ...]

# The figure of `Task.check` by which the best network is chosen: lower is better.
SELECTED_BY = "validation"

_MOST_WORKERS = 8


class Task(Protocol):
    """What a network is trained for. The loop calls `loss` and `check` in the precision of the device."""

    @property
    def network(self) -> nn.Module:
        """The network with its initial weights."""

    @property
    def data(self) -> dict[str, Any]:
        """What the network is trained on, in plain types, for the checkpoint: counts and sources."""

    def batch(self, step: int) -> Batch:
        """Returns the batch of a step on the CPU, the same at every call. Called from other threads."""

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        """Returns the float32 loss of a batch on the network's device."""

    def check(self, network: nn.Module) -> dict[str, float]:
        """Returns the validation figures, among them `validation`, which is lowest for the best network."""


@dataclass(frozen=True)
class TrainingProgress:
    """The state after a step; `figures` are those of a check, empty between checks."""

    step: int
    loss: float
    figures: CurveRow = field(default_factory=dict)


class Run:
    """A run of `task` in `folder`, resumed from where it stopped.

    Raises SettingsError if the folder holds a run with another configuration or other data, CheckpointError if its
    checkpoint can't be read.
    """

    def __init__(self, task: Task, config: TrainConfig, folder: Path) -> None:
        self._task, self._config, self._folder = task, config, folder
        self._device = best_device()
        self._network = task.network.to(self._device)
        self._optimizer = _optimizer(config, self._network)
        self._average = averaged_model(self._network, config.ema) if config.ema else None
        self._record = {"config": config.recorded, "data": task.data, **made_by()}
        self._best = math.inf
        self._losses: list[float] = []
        self._rows: list[CurveRow] = []
        self.step = 0
        folder.mkdir(parents=True, exist_ok=True)
        if self._last.exists():
            self._restore(load_state(self._last))

    @property
    def best(self) -> Path:
        """The checkpoint with the best validation figures."""
        return self._folder / "best.pt"

    @property
    def finished(self) -> bool:
        """Whether all steps are done."""
        return self.step >= self._config.steps

    @property
    def _last(self) -> Path:
        return self._folder / "last.pt"

    def train(self, report: Callable[[TrainingProgress], None], stopped: Callable[[], bool]) -> None:
        """Trains to the end, or until `stopped` returns true after a step; the run is then saved and can be resumed."""
        # The threads of OpenCV and of PyTorch wait for each other: with both, a step takes five times as long.
        cv2.setNumThreads(1)
        for batch in self._batches():
            loss = self._train_step(batch)
            self._losses.append(loss)
            self.step += 1
            is_due = self.step % self._config.check_every == 0 or self.finished
            report(TrainingProgress(self.step, loss, self._check() if is_due else {}))
            if is_due or stopped():
                self._save()
            if stopped():
                break

    def _batches(self) -> Iterator[Batch]:
        """Yields batches from the current step on; the next ones are prepared while the network trains."""
        workers = 1 if self._device.type == "cpu" else min(_MOST_WORKERS, processors())
        pending: deque[Future[Batch]] = deque()
        with ThreadPoolExecutor(workers) as pool:
            try:
                for step in range(self.step, self._config.steps + workers):
                    if step < self._config.steps:
                        pending.append(pool.submit(self._task.batch, step))
                    if step >= self.step + workers and pending:
                        yield pending.popleft().result()
            finally:
                for future in pending:
                    future.cancel()

    def _train_step(self, batch: Batch) -> float:
        torch.manual_seed(self._config.seed * 1_000_003 + self.step)  # for dropout
        self._network.train()
        for group in self._optimizer.param_groups:
            group["lr"] = rate_at(self._config, self.step)
        with autocast(self._device):
            loss = self._task.loss(self._network, tuple(part.to(self._device) for part in batch))
        self._optimizer.zero_grad()
        torch.autograd.backward(loss)
        if self._config.clip:
            nn.utils.clip_grad_norm_(self._network.parameters(), self._config.clip)
        self._optimizer.step()
        if self._average is not None:
            self._average.update_parameters(self._network)
        value = loss.item()
        if not math.isfinite(value):
            raise SettingsError(f"the loss is not a finite number at step {self.step + 1}", "lower the learning rate")
        return value

    @torch.inference_mode()
    def _check(self) -> CurveRow:
        """Validates the network and keeps it if it is the best so far."""
        network: nn.Module = self._average.module if self._average is not None else self._network
        with autocast(self._device):
            figures = self._task.check(network.eval())
        loss = sum(self._losses) / len(self._losses)
        self._losses.clear()
        rate = rate_at(self._config, self.step - 1)
        self._rows.append({"step": self.step, "rate": rate, "loss": loss, **figures})
        write_curve(self._folder, self._rows)
        if figures[SELECTED_BY] < self._best:
            self._best = figures[SELECTED_BY]
            state = {"network": _on_cpu(network), "step": self.step, "figures": figures, "record": self._record}
            write_checkpoint(self.best, state)
        return figures

    def _save(self) -> None:
        """Saves what the run resumes from; of a finished run only that it is finished."""
        state = {"step": self.step, "best": self._best, "rows": self._rows, "record": self._record}
        if not self.finished:
            state["network"] = self._network.state_dict()
            state["optimizer"] = self._optimizer.state_dict()
            state["average"] = self._average.state_dict() if self._average is not None else None
            state["losses"] = self._losses
        write_checkpoint(self._last, state)

    def _restore(self, state: dict[str, Any]) -> None:
        self._require_same(state["record"])
        self.step, self._best, self._rows = int(state["step"]), float(state["best"]), state["rows"]
        if not self.finished:
            self._network.load_state_dict(state["network"])
            self._optimizer.load_state_dict(state["optimizer"])
            self._losses = state["losses"]
            if self._average is not None:
                self._average.load_state_dict(state["average"])

    def _require_same(self, record: dict[str, Any]) -> None:
        for part in ("config", "data"):
            was, now = record[part], self._record[part]
            different = sorted(key for key in was.keys() | now.keys() if was.get(key) != now.get(key))
            if different:
                raise SettingsError(
                    f"{self._folder} holds a run with another {part}: {different[0]} was {was.get(different[0])}",
                    "give a new folder with --run, or resume with what that run was started with",
                )


def averaged_model(network: nn.Module, decay: float) -> AveragedModel:
    """Returns an exponential moving average of the weights of `network` and of its batch normalization statistics.

    `decay` is per step. It starts lower, min(decay, (1 + n) / (10 + n)) after n steps, so that the initial weights are
    forgotten quickly. Source: B. Polyak and A. Juditsky, "Acceleration of stochastic approximation by averaging", 1992,
    in its exponential form.
    """

    def mix(averages: Sequence[Tensor], weights: Sequence[Tensor], steps: Tensor | int) -> None:
        n = int(steps) + 1
        for average, weight in zip(averages, weights, strict=True):
            if average.is_floating_point():
                average.lerp_(weight, 1.0 - min(decay, (1 + n) / (10 + n)))
            else:  # counters of batch normalization
                average.copy_(weight)

    average = AveragedModel(network, multi_avg_fn=torch.no_grad()(mix), use_buffers=True)
    return average.requires_grad_(False).eval()


def best_device() -> torch.device:
    """Returns CUDA if available, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def has_bf16(device: torch.device) -> bool:
    """Whether the device computes in bfloat16 natively; if it only emulates it, float32 is faster and more accurate."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    capabilities = torch.cpu.get_capabilities()
    return bool(capabilities.get("amx_bf16") or capabilities.get("avx512_bf16"))


def autocast(device: torch.device) -> torch.autocast:
    """Returns a context in which networks compute in bfloat16 if the device has it, else in their own precision."""
    return torch.autocast(device.type, torch.bfloat16, enabled=has_bf16(device))


def describe_device(device: torch.device) -> str:
    """Returns the name of the device and its precision."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    return f"{name}, {'bfloat16' if has_bf16(device) else 'float32'}"


def rate_at(config: TrainConfig, step: int) -> float:
    """Returns the learning rate of `step`, counted from 0."""
    schedule, rate = config.schedule, config.optimizer.learning_rate
    if isinstance(schedule, Cosine):
        rising = min(1.0, (step + 1) / schedule.warm_up) if schedule.warm_up else 1.0
        return rate * rising * 0.5 * (1.0 + math.cos(math.pi * step / config.steps))
    return float(rate * schedule.factor ** (step // schedule.every))


def _optimizer(config: TrainConfig, network: nn.Module) -> torch.optim.Optimizer:
    settings = config.optimizer
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
