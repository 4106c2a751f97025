"""What the classifier and the regressor learn from: their losses, and how often patches and frames are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from lanestream.errors import LabelError
from lanestream_exporter.alexnet import AlexNet, ClassifierLogits
from lanestream_exporter.samples.patch_files import PatchStore, read_stores, write_store
from lanestream_exporter.samples.patches import Patches
from lanestream_exporter.samples.road_frames import RoadFrame
from lanestream_exporter.samples.truth import MARKING, NOTHING, ROAD_EDGE
from lanestream_exporter.training.classifier import (
    ClassifierTask,
    _cumulative_chances,
    kind_losses,
    starting_network,
    sum_of_losses,
)
from lanestream_exporter.training.config import ClassifierConfig, ClassifierData, NetworkSize
from lanestream_exporter.training.data_sources import PatchSource
from lanestream_exporter.training.regressor import frame_chances
from lanestream_exporter.training.run_files import read_checkpoint, write_checkpoint
from lanestream_exporter.training.shipped import write_half

Targets = Sequence[tuple[int, int, int]]

SIZE = NetworkSize(size=64, width=0.1, hidden=8)

# --- Losses ---------------------------------------------------------------------------------------------------------


def logits(number: int, seed: int = 0) -> ClassifierLogits:
    """Returns random logits."""
    return ClassifierLogits.of(2.0 * torch.randn(number, 9, generator=torch.Generator().manual_seed(seed)))


def test_the_loss_of_a_kind_is_that_of_all_kinds_that_a_patch_may_show() -> None:
    allowed = torch.arange(1, 8)
    kinds = logits(7).kinds
    probabilities = torch.softmax(kinds.double(), dim=1)
    bits = torch.tensor([[bool(int(each) & bit) for bit in (NOTHING, MARKING, ROAD_EDGE)] for each in allowed])
    expected = -torch.log((probabilities * bits).sum(dim=1))
    torch.testing.assert_close(kind_losses(kinds, allowed).double(), expected)
    assert kind_losses(kinds, allowed)[6] == pytest.approx(0.0, abs=1e-6)


def test_a_kind_that_a_patch_may_show_is_not_learnt_away() -> None:
    kinds = torch.zeros(1, 3, requires_grad=True)
    kind_losses(kinds, torch.tensor([NOTHING | ROAD_EDGE])).sum().backward()  # type: ignore[no-untyped-call]
    assert kinds.grad is not None
    nothing, marking, edge = kinds.grad[0].tolist()
    assert nothing == pytest.approx(edge)
    assert nothing < 0.0 < marking


def test_types_and_colors_count_where_they_are_known() -> None:
    found = logits(4)
    targets = torch.tensor([[MARKING, 1, -1], [MARKING, -1, 1], [NOTHING, -1, -1], [ROAD_EDGE, -1, -1]])
    types, colors = torch.log_softmax(found.types, dim=1), torch.log_softmax(found.colors, dim=1)
    expected = kind_losses(found.kinds, targets[:, 0]).mean() - (0.3 * types[0, 1] + 0.2 * colors[1, 1]) / (0.38 * 4)
    torch.testing.assert_close(sum_of_losses(found, targets), expected)


def test_the_loss_is_finite_without_any_known_type_or_color_and_for_certain_outputs() -> None:
    targets = torch.tensor([[NOTHING, -1, -1], [ROAD_EDGE, -1, -1]])
    wrong = torch.tensor([[-80.0, 80.0, 0.0], [80.0, 0.0, -80.0]])
    found = replace(logits(2), kinds=wrong)
    for smoothing in (0.0, 0.05):
        loss = sum_of_losses(found, targets, smoothing)
        assert torch.isfinite(loss)
        assert loss > 100.0


def test_half_precision_keeps_weights_and_record(tmp_path: Path) -> None:
    config = ClassifierConfig(network=SIZE)
    network = starting_network(config)
    record = {"config": config.recorded}
    state = {
        "network": network.state_dict(),
        "step": 7,
        "figures": {"validation": 0.5},
        "record": record,
        "optimizer": {},
    }
    write_checkpoint(tmp_path / "best.pt", state)
    write_half(tmp_path / "best.pt", tmp_path / "half.pt")
    half = read_checkpoint(tmp_path / "half.pt")
    assert {key: half[key] for key in half if key != "network"} == {
        key: state[key] for key in ("step", "figures", "record")
    }
    again = starting_network(config.model_copy(update={"initial": str(tmp_path / "half.pt")}))
    for key, value in network.state_dict().items():
        torch.testing.assert_close(again.state_dict()[key], value, rtol=1e-3, atol=1e-6)


# --- Drawing patches and frames -------------------------------------------------------------------------------------


def store_of(targets: Targets, sets: Sequence[int] | None = None) -> PatchStore:
    """Returns a store of these targets, without pixels."""
    number = len(targets)
    of_sets = np.zeros(number, np.int16) if sets is None else np.array(sets, np.int16)
    empty = np.zeros(0, np.uint8), np.zeros(number + 1, np.int64)
    return PatchStore(*empty, np.array(targets, np.int8), of_sets, ("first", "second"))


def chances(store: PatchStore) -> NDArray[np.float64]:
    """Returns the chances (N,) of the patches of a store."""
    cumulative = _cumulative_chances(store)
    assert cumulative[-1] == pytest.approx(1.0)
    return np.diff(cumulative, prepend=0.0)


def test_kinds_are_drawn_by_their_shares_whatever_their_numbers() -> None:
    targets = [(NOTHING, -1, -1)] * 50 + [(MARKING, -1, -1)] * 20 + [(ROAD_EDGE, -1, -1)] * 3
    both = [(MARKING | ROAD_EDGE, -1, -1), (NOTHING | ROAD_EDGE, -1, -1)]
    drawn = chances(store_of(targets + both))
    assert [part.sum() for part in np.split(drawn, [50, 70, 73])] == pytest.approx([0.42, 0.38, 0.15, 0.05])


def test_a_kind_that_is_missing_leaves_its_share_to_the_others() -> None:
    drawn = chances(store_of([(NOTHING, -1, -1)] * 7 + [(MARKING, -1, -1)]))
    assert drawn[-1] == pytest.approx(0.38 / 0.8)


def test_data_sets_types_and_colors_count_by_the_square_root_of_their_numbers() -> None:
    nothing = [(NOTHING, -1, -1)] * 100
    drawn = chances(store_of(nothing, [0] * 90 + [1] * 10))
    assert drawn[:90].sum() / drawn[90:].sum() == pytest.approx(3.0)
    markings = [(MARKING, 0, 0)] * 64 + [(MARKING, 1, 0)] * 16 + [(MARKING, 1, 1)] * 4 + [(MARKING, -1, -1)]
    drawn = chances(store_of(markings))
    assert [part.sum() / drawn[-1] for part in np.split(drawn[:-1], [64, 80])] == pytest.approx([8.0, 4.0, 2.0])


def frames(*drives: tuple[str, str, int]) -> list[RoadFrame]:
    """Returns frames of drives, each given by its data set, its name and its number of frames."""
    one = RoadFrame(b"", 64, 64, (), (), 20.0, exhaustive=False, group="", dataset="")
    return [replace(one, dataset=name, group=group) for name, group, number in drives for _ in range(number)]


def test_frames_of_data_sets_and_drives_count_by_the_square_root_of_their_numbers() -> None:
    drawn = frame_chances(frames(("large", "a", 90), ("small", "b", 8), ("small", "c", 2)))
    assert drawn.sum() == pytest.approx(1.0)
    large, first, second = (part.sum() for part in np.split(drawn, [90, 98]))
    assert large / (first + second) == pytest.approx(3.0)
    assert first / second == pytest.approx(2.0)


# --- The task -------------------------------------------------------------------------------------------------------


EVERY_KIND = ((NOTHING, -1, -1), (MARKING, 1, 0), (MARKING, 0, 1), (ROAD_EDGE, -1, -1), (NOTHING | ROAD_EDGE, -1, -1))


def stored(path: Path, targets: Targets) -> PatchStore:
    """Writes patches of noise that have these targets, and reads them."""
    pixels = np.random.default_rng(0).integers(0, 256, (len(targets), 64, 64, 3), dtype=np.uint8)
    write_store(path, [("mine", Patches(pixels, np.array(targets, np.int8)))])
    return read_stores([path])


def task_of(folder: Path, targets: Targets) -> ClassifierTask:
    """Returns a task with real patches of noise that have these targets."""
    store = stored(folder / "real.npz", targets)
    data = ClassifierData(rendered_scenes=0, real_share=1.0, final_real_share=1.0)
    config = ClassifierConfig(batch=200, network=SIZE, data=data)
    return ClassifierTask(config, starting_network(config), [PatchSource("real", store, store)], {})


def test_some_patches_to_validate_with_show_no_boundary(tmp_path: Path) -> None:
    every = stored(tmp_path / "all.npz", EVERY_KIND)
    few = PatchSource("real", every, stored(tmp_path / "boundaries.npz", EVERY_KIND[1:]))
    config = ClassifierConfig(network=SIZE)
    network = starting_network(config)
    with pytest.raises(LabelError, match=r"no patches without a boundary to validate with \(give more frames, or"):
        ClassifierTask(config, network, [few], {})
    ClassifierTask(config, network, [few, PatchSource("rendered", every, every)], {})


@pytest.fixture
def task(tmp_path: Path) -> ClassifierTask:
    """Returns a task with a few real patches of all kinds."""
    return task_of(tmp_path, EVERY_KIND)


def test_a_batch_has_the_targets_of_its_patches_in_their_shares(task: ClassifierTask) -> None:
    pixels, targets = task.batch(0)
    assert (tuple(pixels.shape), pixels.dtype) == ((200, 64, 64, 3), torch.uint8)
    assert tuple(targets.shape) == (200, 3)
    shares = [float((targets[:, 0] == kind).float().mean()) for kind in (NOTHING, MARKING, ROAD_EDGE)]
    assert shares == pytest.approx([0.42, 0.38, 0.15], abs=0.1)
    assert {tuple(row) for row in targets.tolist() if row[0] == MARKING} == {(MARKING, 1, 0), (MARKING, 0, 1)}
    again, _ = task.batch(0)
    assert torch.equal(pixels, again)


def test_one_step_lowers_the_loss_of_its_batch(task: ClassifierTask) -> None:
    batch = task.batch(0)
    optimizer = torch.optim.SGD(task.network.parameters(), 0.01)
    task.network.train()
    before = []
    for _ in range(6):
        torch.manual_seed(1)
        loss = task.loss(task.network, batch)
        before.append(loss.item())
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    assert np.isfinite(before).all()
    assert before[-1] < before[0]


def test_a_check_reports_kinds_types_and_colors(task: ClassifierTask) -> None:
    figures = task.check(task.network.eval())
    assert set(figures) == {
        "validation",
        "real_loss",
        "real_accuracy",
        "real_type_accuracy",
        "real_color_accuracy",
    }
    assert figures["validation"] == figures["real_loss"] > 0.0
    assert all(0.0 <= figures[name] <= 1.0 for name in figures if name.endswith("accuracy"))


def certain(*biases: float) -> AlexNet:
    """Returns a network with these outputs for every patch."""
    network = AlexNet(shape=SIZE.shape, batch_norm=False).eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        network.classifier[6].bias.copy_(torch.tensor(biases))  # type: ignore[union-attr, operator]
    return network


def test_an_answer_counts_by_its_kind_and_each_kind_equally(task: ClassifierTask) -> None:
    dashed_white = certain(0.0, 9.0, 0.0, 0.0, 9.0, 0.0, 0.0, 9.0, 0.0)
    figures = task.check(dashed_white)
    assert figures["real_accuracy"] == pytest.approx(1.0 / 3.0)
    assert figures["real_type_accuracy"] == figures["real_color_accuracy"] == pytest.approx(0.5)


def test_boundaries_of_unknown_kind_count_in_a_check(tmp_path: Path) -> None:
    """Labels of a user may say only that there is a boundary."""
    task = task_of(tmp_path, [(NOTHING, -1, -1), (MARKING | ROAD_EDGE, -1, -1), (MARKING | ROAD_EDGE, -1, -1)])
    nothing = task.check(certain(9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert nothing["real_accuracy"] == pytest.approx(0.5)
    assert nothing["real_loss"] > 3.0
    for kind in ((0.0, 9.0, 0.0), (0.0, 0.0, 9.0)):
        assert task.check(certain(*kind, *[0.0] * 6))["real_accuracy"] == pytest.approx(0.5)
