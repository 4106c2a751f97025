"""Recipes: the configuration of a training run, read from a TOML file and checked completely."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from lanestream.engine import resolve_regressor
from lanestream_exporter.alexnet import Shape
from lanestream_exporter.datasets.label_propagation import LabelPropagation
from lanestream_exporter.datasets.manifest import SHIPPED_MANIFEST
from lanestream_exporter.samples.augment import Augmentation, Corruptions
from lanestream_exporter.toml_files import CONFIG_FOLDER, Section, Share, read_toml
from lanestream_exporter.training.shipped import SHIPPED


class AdamW(Section):
    """I. Loshchilov and F. Hutter, "Decoupled weight decay regularization", 2019."""

    kind: Literal["adamw"] = "adamw"
    learning_rate: PositiveFloat = 8e-4
    weight_decay: Annotated[float, Field(ge=0.0)] = 0.02


class Sgd(Section):
    """Stochastic gradient descent with momentum."""

    kind: Literal["sgd"]
    learning_rate: PositiveFloat = 1e-3
    weight_decay: Annotated[float, Field(ge=0.0)] = 1e-4
    momentum: Share = 0.9


class Cosine(Section):
    """The learning rate rises for `warm_up` steps and then falls along half a cosine to zero."""

    kind: Literal["cosine"] = "cosine"
    warm_up: NonNegativeInt = 100


class Staircase(Section):
    """The learning rate is multiplied by `factor` after every `every` steps."""

    kind: Literal["staircase"]
    every: PositiveInt
    factor: Annotated[float, Field(gt=0.0, le=1.0)] = 0.1


class TrainConfig(Section):
    """What the runs of all networks have: steps, batch size, optimizer, schedule, initial weights.

    `ema` is the decay per step of the moving average of the weights, 0 for none; `clip` is the largest gradient norm,
    0 for no limit. `initial` is the file of the weights to start from, or `shipped` for those of the shipped network.
    All paths of the file count from the folder that the command runs in.
    """

    seed: NonNegativeInt = 1
    steps: PositiveInt = 7000
    batch: Annotated[int, Field(ge=2)] = 96
    check_every: PositiveInt = 700
    ema: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.998
    clip: Annotated[float, Field(ge=0.0)] = 5.0
    initial: str | None = None
    optimizer: Annotated[AdamW | Sgd, Field(discriminator="kind")] = AdamW()
    schedule: Annotated[Cosine | Staircase, Field(discriminator="kind")] = Cosine()

    @property
    def recorded(self) -> dict[str, Any]:
        """The whole configuration in plain types, defaults included."""
        return self.model_dump(mode="json")


class NetworkSize(Section):
    """The size of the network, as in `alexnet.Shape`. Its inputs have the same `size`."""

    size: Annotated[int, Field(ge=63)] = 112
    width: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    hidden: PositiveInt = 512

    @property
    def shape(self) -> Shape:
        """The same for the network."""
        return Shape(self.size, self.width, self.hidden)


class TrainingData(Section):
    """Where a run's frames come from, and the share of each batch that is real: `final_real_share` in the last third.

    Real frames are those of the `manifest`, a TOML file as `datasets.manifest` reads it; without it of the shipped one.
    `propagation_stride` also trains on every n-th frame between two labeled frames of a video, labeled by
    `datasets.label_propagation`; 0 for none. The data sets named in `without` are left out. `rendered_scenes` train and
    `validation_scenes` validate. Of `hard_scenes` more, those train on which the detectors with the networks of
    `committee`, the ONNX files of a classifier and of a regressor, disagree. `no_road_pictures` more show no road.
    """

    manifest: str | None = None
    without: tuple[str, ...] = ()
    propagation_stride: NonNegativeInt = 5
    rendered_scenes: NonNegativeInt = 5000
    validation_scenes: PositiveInt = 100
    no_road_pictures: NonNegativeInt = 0
    hard_scenes: NonNegativeInt = 0
    committee: tuple[str, str] | None = None
    real_share: Share = 0.3
    final_real_share: Share = 0.5

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.committee is None) != (self.hard_scenes == 0):
            raise ValueError("hard_scenes and committee are only accepted together")
        if self.rendered_scenes == 0 and min(self.real_share, self.final_real_share) < 1.0:
            raise ValueError("without rendered scenes real_share and final_real_share must be 1")
        if self.manifest is not None and not self.has_real_frames:
            raise ValueError("with a manifest real_share or final_real_share must be more than 0")
        return self

    @property
    def has_real_frames(self) -> bool:
        """Whether any batch holds real frames."""
        return max(self.real_share, self.final_real_share) > 0.0

    @property
    def propagation(self) -> LabelPropagation | None:
        """The label propagation, or None if it is off."""
        return LabelPropagation(self.propagation_stride) if self.propagation_stride else None


class ClassifierData(TrainingData):
    """Where a classifier's patches come from.

    `regressor` is an ONNX file, or `shipped`: candidates are then proposed as when the two are served together.
    """

    regressor: str | None = None

    @property
    def regressor_file(self) -> Path | None:
        """The ONNX file of the regressor, if any."""
        if self.regressor is None:
            return None
        return resolve_regressor(None) if self.regressor == SHIPPED else Path(self.regressor)


class ClassifierConfig(TrainConfig):
    """The configuration of a classifier run."""

    label_smoothing: Share = 0.05
    network: NetworkSize = NetworkSize()
    data: ClassifierData = ClassifierData()
    augmentation: Augmentation = Augmentation()


class RegressorData(TrainingData):
    """Where a regressor's frames come from."""

    rendered_scenes: NonNegativeInt = 12000
    validation_scenes: PositiveInt = 250
    real_share: Share = 0.35


class RegressorConfig(TrainConfig):
    """The configuration of a regressor run."""

    batch: Annotated[int, Field(ge=2)] = 64
    network: NetworkSize = NetworkSize(size=224, width=0.5, hidden=1024)
    data: RegressorData = RegressorData()
    corruptions: Corruptions = Corruptions()


C = TypeVar("C", bound=TrainConfig)


def shipped_recipes() -> dict[str, Path]:
    """Returns the shipped recipes by name."""
    return {path.stem: path for path in sorted(CONFIG_FOLDER.glob("*.toml")) if path != SHIPPED_MANIFEST}


def read_config(path: Path, kind: type[C]) -> C:
    """Returns the recipe in the TOML file at `path`, or the shipped recipe of that name.

    Raises SettingsError with one line that names the file, the key and what is accepted.
    """
    recipes = shipped_recipes()
    file = recipes.get(str(path), path) if not path.exists() else path
    return read_toml(file, kind, f"give a TOML file, or one of {', '.join(recipes)}")
