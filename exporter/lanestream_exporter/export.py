"""From a checkpoint to an ONNX file that describes itself and has proved itself."""

from __future__ import annotations

import logging
import tempfile
import warnings
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from scipy.special import softmax
from torch import Tensor, nn

from lanestream.errors import ExportError
from lanestream.geometry import StripGeometry
from lanestream.inference import ClassifierInfo, OnnxModel, StripInfo
from lanestream.inference.model_info import METADATA_KEY
from lanestream_exporter.alexnet import INPUT_SIZE, AlexNet, normalise
from lanestream_exporter.calibration import Calibration, calibrated
from lanestream_exporter.compression import truncated
from lanestream_exporter.patchstore import PatchStore
from lanestream_exporter.quantize import quantized
from lanestream_exporter.training.checkpoints import read_checkpoint
from lanestream_exporter.training.scores import scores

Precision = Literal["fp32", "int8"]

# The largest difference in probability that a file may show against PyTorch on the same patches. int8 rounds every
# layer, so there the mean counts, and the accuracy it costs.
_TOLERANCE = 1e-3
_INT8_MEAN_TOLERANCE = 0.05
_LARGEST_ACCURACY_LOSS = 0.02

_BATCHES = (1, 4, 16)

_DATA = "rendered scenes; real frames of TuSimple 0313-1 and Udacity, training splits only"


@dataclass(frozen=True)
class ExportSettings:
    """What to write: the `precision`, and the share of the linear layers' `rank_energy` to keep."""

    name: str = "lanestream-alexnet"
    precision: Precision = "int8"
    rank_energy: float = 0.99


@dataclass(frozen=True)
class ExportReport:
    """What the written file was measured to be, against the PyTorch network on the same validation patches."""

    path: Path
    size: int
    calibration: Calibration
    accuracy: dict[str, float]
    mean_difference: float
    largest_difference: float
    patches: int


class ServedNetwork(nn.Module):
    """What goes into the file: uint8 patches in, calibrated probabilities out."""

    def __init__(self, network: AlexNet, temperature: float) -> None:
        super().__init__()
        self.network = network
        self.temperature = temperature

    def forward(self, patches: Tensor) -> Tensor:
        """Probabilities (N, classes) of RGB patches (N, H, W, 3) uint8."""
        return torch.softmax(self.network(normalise(patches)) / self.temperature, dim=1)


def export_classifier(
    checkpoint: Path, out: Path, settings: ExportSettings, calibration_patches: PatchStore, check: PatchStore
) -> ExportReport:
    """Writes the classifier in `checkpoint` to `out` (.onnx) and returns what it measures.

    `calibration_patches` (training ones) choose what the linear layers keep and set the ranges of int8; `check`
    (validation ones) sets temperature and threshold and proves the file. Raises CheckpointError, or ExportError where
    the file misses the tolerance; then nothing is written.
    """
    state = read_checkpoint(checkpoint)
    network = AlexNet()
    network.load_state_dict(state["network"])
    plain = network.eval().folded()
    roads = _sample(calibration_patches, 1024)
    small = truncated(plain, settings.rank_energy, roads)
    logits = scores(small, check)
    calibration = calibrated(logits, check.labels)
    accuracy = _accuracy(softmax(logits / calibration.temperature, axis=1), check.labels, calibration.threshold)
    served = ServedNetwork(small, calibration.temperature).eval()
    with tempfile.TemporaryDirectory() as folder:
        unfinished = Path(folder) / "model.onnx"
        _to_onnx(served, unfinished)
        if settings.precision == "int8":
            quantized(unfinished, roads[::4])
        training = {"data": _DATA, "step": int(state["step"]), "rank_energy": settings.rank_energy}
        metrics = {"validation_patches": len(check), "validation_accuracy": round(accuracy, 4)}
        _describe(unfinished, settings, calibration, {"training": training, "metrics": metrics})
        report = _proved(unfinished, out, served, calibration, check, settings.precision)
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes(unfinished.read_bytes())
    return report


def _to_onnx(served: ServedNetwork, path: Path) -> None:
    example = torch.zeros(2, INPUT_SIZE, INPUT_SIZE, 3, dtype=torch.uint8)
    # The exporter warns of its own innards and of torchvision's absence: nothing that a user could mend.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            served,
            (example,),
            input_names=["patches"],
            output_names=["probabilities"],
            dynamic_shapes={"patches": {0: torch.export.Dim("batch", min=1, max=1024)}},
            dynamo=True,
            verbose=False,
        )
    assert program is not None  # noqa: S101 - dynamo=True always returns a program
    program.save(str(path), external_data=False)


def _describe(path: Path, settings: ExportSettings, calibration: Calibration, record: dict[str, Any]) -> None:
    strip = StripGeometry()
    info = ClassifierInfo(
        kind="classifier",
        name=settings.name,
        version=version("lanestream"),
        classes=("false", "lane"),
        strip=StripInfo(size=strip.size, half_width=strip.half_width, min_half_width=strip.min_half_width),
        temperature=calibration.temperature,
        threshold=calibration.threshold,
        precision=settings.precision,
        **record,
        exporter=f"lanestream {version('lanestream')}, torch {torch.__version__}",
    )
    model = onnx.load(str(path))
    onnx.helper.set_model_props(model, {METADATA_KEY: info.model_dump_json()})
    onnx.save(model, str(path))


def _proved(
    path: Path, out: Path, served: ServedNetwork, calibration: Calibration, check: PatchStore, precision: Precision
) -> ExportReport:
    """Runs the same patches through PyTorch and through the file. Raises ExportError where they differ too much."""
    patches = np.stack([check.patch(i) for i in range(len(check))])
    model = OnnxModel.load(path, "cpu")
    expected = _torch_probabilities(served, patches)
    by_batch = [
        np.concatenate([model.run(patches[i : i + batch]) for i in range(0, len(patches), batch)]) for batch in _BATCHES
    ]
    difference = np.max([np.abs(got - expected)[:, 1] for got in by_batch], axis=0)
    accuracy = {
        "PyTorch": _accuracy(expected, check.labels, calibration.threshold),
        precision: _accuracy(by_batch[0], check.labels, calibration.threshold),
    }
    mean, largest = float(difference.mean()), float(difference.max())
    lost = accuracy["PyTorch"] - accuracy[precision]
    missed = mean > _INT8_MEAN_TOLERANCE if precision == "int8" else largest > _TOLERANCE
    if missed or lost > _LARGEST_ACCURACY_LOSS:
        raise ExportError(
            f"the file differs from PyTorch by {mean:.4f} on average, {largest:.4f} at most, and loses {lost:.1%}",
            "export with precision fp32 or a higher rank energy",
        )
    return ExportReport(out, path.stat().st_size, calibration, accuracy, mean, largest, len(patches))


@torch.inference_mode()
def _torch_probabilities(served: ServedNetwork, patches: NDArray[np.uint8]) -> NDArray[np.float32]:
    parts = [served(torch.from_numpy(patches[i : i + 32])).numpy() for i in range(0, len(patches), 32)]
    return np.concatenate(parts)


def _accuracy(probabilities: NDArray[np.float32], labels: NDArray[np.int64], threshold: float) -> float:
    return float(((probabilities[:, 1] >= threshold) == (labels == 1)).mean())


def _sample(store: PatchStore, count: int) -> NDArray[np.uint8]:
    chosen = np.random.default_rng(0).choice(len(store), min(count, len(store)), replace=False)
    return np.stack([store.patch(int(i)) for i in np.sort(chosen)])
