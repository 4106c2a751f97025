"""The training loop is seeded and resumable and refuses mismatches; recipes and the moving average."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from lanestream.errors import CheckpointError, SettingsError
from lanestream_exporter.toml_files import CONFIG_FOLDER
from lanestream_exporter.training.classifier import starting_network
from lanestream_exporter.training.config import (
    AdamW,
    ClassifierConfig,
    Cosine,
    NetworkSize,
    RegressorConfig,
    Sgd,
    Staircase,
    TrainConfig,
    read_config,
)
from lanestream_exporter.training.loop import Batch, Run, TrainingProgress, averaged_model, rate_at
from lanestream_exporter.training.regressor import starting_regressor
from lanestream_exporter.training.run_files import read_checkpoint, write_checkpoint


class Parity:
    """Learns whether two signs agree, with a small network with dropout and batch normalization."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        self.network = nn.Sequential(nn.Linear(2, 16), nn.BatchNorm1d(16), nn.ReLU(), nn.Dropout(0.2), nn.Linear(16, 1))
        self.data: dict[str, Any] = {"samples": 64}

    def batch(self, step: int) -> Batch:
        generator = torch.Generator().manual_seed(step)
        x = torch.randn((64, 2), generator=generator)
        return x, (x[:, :1] * x[:, 1:] > 0).float()

    def loss(self, network: nn.Module, batch: Batch) -> Tensor:
        return functional.binary_cross_entropy_with_logits(network(batch[0]).float(), batch[1])

    def check(self, network: nn.Module) -> dict[str, float]:
        return {"validation": self.loss(network, self.batch(1_000_000)).item()}


CONFIG = TrainConfig(
    steps=60, check_every=20, ema=0.9, clip=0.0, optimizer=AdamW(learning_rate=0.05), schedule=Cosine(warm_up=5)
)


def trained(folder: Path, config: TrainConfig = CONFIG, stop_at: int | None = None) -> list[TrainingProgress]:
    reports: list[TrainingProgress] = []
    Run(Parity(), config, folder).train(reports.append, lambda: reports[-1].step == stop_at)
    return reports


def weights(path: Path) -> dict[str, Tensor]:
    found: dict[str, Tensor] = read_checkpoint(path)["network"]
    return found


@pytest.mark.parametrize("stop_at", [7, 20, 59])
def test_a_resumed_run_gives_the_same_result(tmp_path: Path, stop_at: int) -> None:
    whole = trained(tmp_path / "whole")
    first = trained(tmp_path / "parts", stop_at=stop_at)
    second = trained(tmp_path / "parts")
    assert [p.step for p in first + second] == list(range(1, 61))
    assert first + second == whole
    expected, got = (weights(tmp_path / name / "best.pt") for name in ("whole", "parts"))
    assert expected.keys() == got.keys()
    assert all(torch.equal(expected[key], got[key]) for key in expected)
    assert (tmp_path / "whole" / "curve.csv").read_text() == (tmp_path / "parts" / "curve.csv").read_text()
    assert (tmp_path / "parts" / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_it_learns_and_keeps_the_best_network_with_its_record(tmp_path: Path) -> None:
    reports = trained(tmp_path)
    checks = [p.figures["validation"] for p in reports if p.figures]
    assert len(checks) == 3
    assert min(checks) < 0.4 < checks[0] + 0.3
    best = read_checkpoint(tmp_path / "best.pt")
    assert best["figures"]["validation"] == min(checks)
    assert best["record"]["config"] == CONFIG.recorded
    assert best["record"]["data"] == {"samples": 64}
    assert best["record"]["torch"] == torch.__version__


def test_a_finished_run_does_nothing_more(tmp_path: Path) -> None:
    trained(tmp_path)
    before = (tmp_path / "best.pt").read_bytes()
    assert trained(tmp_path) == []
    assert (tmp_path / "best.pt").read_bytes() == before


def test_a_run_with_another_configuration_or_data_is_refused(tmp_path: Path) -> None:
    trained(tmp_path, stop_at=5)
    with pytest.raises(SettingsError, match="another config: seed was 1"):
        trained(tmp_path, CONFIG.model_copy(update={"seed": 2}))
    task = Parity()
    task.data["samples"] = 65
    with pytest.raises(SettingsError, match="another data: samples was 64"):
        Run(task, CONFIG, tmp_path)


def test_a_broken_checkpoint_is_reported(tmp_path: Path) -> None:
    (tmp_path / "last.pt").write_text("half a file")
    with pytest.raises(CheckpointError, match=r"last\.pt"):
        Run(Parity(), CONFIG, tmp_path)


def test_a_diverging_run_is_reported(tmp_path: Path) -> None:
    config = TrainConfig(steps=50, clip=0.0, optimizer=Sgd(kind="sgd", learning_rate=1e30))
    with pytest.raises(SettingsError, match="lower the learning rate"):
        trained(tmp_path, config)


def test_the_average_follows_the_weights_and_forgets_the_initial_ones() -> None:
    network = nn.BatchNorm1d(1)
    average = averaged_model(network, 0.9)
    values = []
    for step in range(200):
        with torch.no_grad():
            network.weight.fill_(5.0 if step < 100 else 7.0)
            assert network.running_mean is not None
            network.running_mean.fill_(3.0)
        average.update_parameters(network)
        values.append(average.module.state_dict()["weight"].item())
    assert values[9] == pytest.approx(5.0, abs=0.05)  # the initial weight is 1
    assert values[109] == pytest.approx(7.0 - 2.0 * 0.9**10, abs=0.01)
    assert average.module.state_dict()["running_mean"].item() == pytest.approx(3.0, abs=1e-3)
    assert not any(parameter.requires_grad for parameter in average.module.parameters())


def test_schedules() -> None:
    cosine = TrainConfig(steps=1000, optimizer=AdamW(learning_rate=3e-4), schedule=Cosine(warm_up=100))
    assert rate_at(cosine, 49) == pytest.approx(1.5e-4, rel=0.01)
    assert rate_at(cosine, 500) == pytest.approx(1.5e-4)
    assert rate_at(cosine, 999) < 1e-8
    stairs = TrainConfig(optimizer=Sgd(kind="sgd"), schedule=Staircase(kind="staircase", every=10))
    assert [rate_at(stairs, step) for step in (9, 10, 20)] == pytest.approx([1e-3, 1e-4, 1e-5])


def without_data(config: ClassifierConfig | RegressorConfig) -> dict[str, Any]:
    """Returns a configuration without what the shipped recipes set on purpose: their data and the warm-up."""
    return config.model_dump(exclude={"data": {"without", "regressor"}, "schedule": {"warm_up"}})


def test_the_shipped_recipes_are_read() -> None:
    classifier = read_config(Path("classifier"), ClassifierConfig)
    assert without_data(classifier) == without_data(ClassifierConfig())
    regressor = read_config(Path("regressor"), RegressorConfig)
    assert without_data(regressor) == without_data(RegressorConfig())
    # Both leave out the same data set: the first run of a network shows what training on new roads is worth.
    assert classifier.data.without == regressor.data.without
    assert len(classifier.data.without) == 1
    more = (
        read_config(Path("classifier-second"), ClassifierConfig),
        read_config(Path("regressor-second"), RegressorConfig),
    )
    assert [second.initial for second in more] == ["runs/classifier/best.pt", "runs/regressor/best.pt"]
    for second in more:
        assert second.data.without == ()
        assert second.data.committee == ("out/classifier-first.onnx", "out/regressor-first.onnx")
    fine = (
        read_config(Path("classifier-finetune"), ClassifierConfig),
        read_config(Path("regressor-finetune"), RegressorConfig),
    )
    assert [tuned.initial for tuned in fine] == ["shipped", "shipped"]
    assert fine[0].data.regressor == "shipped"
    trial = read_config(Path("classifier-trial"), ClassifierConfig)
    assert (trial.initial, trial.data.regressor, trial.data.manifest) == ("shipped", "shipped", None)
    toy = read_config(Path("classifier-toy"), ClassifierConfig)
    assert (toy.data.propagation_stride, toy.data.manifest) == (0, None)
    published = read_config(CONFIG_FOLDER / "classifier-published.toml", ClassifierConfig)
    assert published.optimizer == Sgd(kind="sgd", learning_rate=0.001, momentum=0.9, weight_decay=1e-4)
    assert published.batch == 15


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("stepps = 3", "unknown key stepps (accepted here: seed, steps, batch"),
        ("steps = 0", "steps = 0 is not accepted (Input should be greater than 0)"),
        (
            '[optimizer]\nkind = "adamw"\nmomentum = 0.9',
            "unknown key optimizer.momentum (accepted here: kind, learning_rate, w",
        ),
        ('[optimizer]\nkind = "lion"', "optimizer = {'kind': 'lion'} is not accepted"),
        ("[optimizer]\nlearning_rate = 3e-4", "optimizer = {'learning_rate': 0.0003} is not accepted"),
        ("[data]\nrendered_scenes = 0", "data: without rendered scenes real_share and final_real_share must be 1"),
        (
            '[data]\nmanifest = "a.toml"\nreal_share = 0\nfinal_real_share = 0',
            "with a manifest real_share or final_real",
        ),
        ("[data]\nhard_scenes = 9", "data: hard_scenes and committee are only accepted together"),
        ('[data]\ncommittee = ["a.onnx", "b.onnx"]', "hard_scenes and committee are only accepted together"),
        ('[data]\nhard_scenes = 9\ncommittee = ["a.onnx"]', "data.committee"),
        ("data = 3", "data = 3 is not accepted"),
        ("steps", "is not a TOML file"),
    ],
)
def test_a_bad_recipe_is_reported_in_one_line(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(SettingsError) as raised:
        read_config(path, ClassifierConfig)
    message = str(raised.value)
    assert message.startswith(str(path))
    assert expected in message
    assert "\n" not in message


def test_a_regressor_only_starts_from_convolutions_of_its_own_width(tmp_path: Path) -> None:
    def saved(width: float) -> str:
        size = NetworkSize(size=63, width=width, hidden=8)
        path = tmp_path / f"{width}.pt"
        write_checkpoint(path, {"network": starting_network(ClassifierConfig(network=size)).state_dict()})
        return str(path)

    size = NetworkSize(size=63, width=0.1, hidden=8)
    same = saved(0.1)
    network = starting_regressor(RegressorConfig(network=size, initial=same))
    for key, value in read_checkpoint(Path(same))["network"].items():
        if key.startswith("features"):
            assert torch.equal(network.state_dict()[key], value)
    write_checkpoint(tmp_path / "none.pt", {"network": 3})
    for other in (saved(0.2), str(tmp_path / "none.pt")):
        with pytest.raises(
            CheckpointError, match=r"does not hold the convolutions of this network .*same \[network\] width"
        ):
            starting_regressor(RegressorConfig(network=size, initial=other))
