"""What a run is told in a TOML file: read once, checked wholly, refused in one line."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, PositiveFloat, PositiveInt, ValidationError
from pydantic import model_validator as checked

from lanestream.errors import SettingsError
from lanestream_exporter.alexnet import Shape
from lanestream_exporter.datasets.label_propagation import Between

Share = Annotated[float, Field(ge=0.0, le=1.0)]

SHIPPED = Path(__file__).parent.parent / "configs"


class Section(BaseModel):
    """A table of the file: nothing in it may be unknown."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class AdamW(Section):
    """I. Loshchilov and F. Hutter, "Decoupled weight decay regularization", 2019."""

    kind: Literal["adamw"] = "adamw"
    learning_rate: PositiveFloat = 6e-4
    weight_decay: Annotated[float, Field(ge=0.0)] = 0.02


class Sgd(Section):
    """Stochastic gradient descent with momentum."""

    kind: Literal["sgd"]
    learning_rate: PositiveFloat = 1e-3
    weight_decay: Annotated[float, Field(ge=0.0)] = 1e-4
    momentum: Share = 0.9


class Cosine(Section):
    """The rate rises for `warm_up` steps and falls along half a cosine to nothing at the end."""

    kind: Literal["cosine"] = "cosine"
    warm_up: NonNegativeInt = 100


class Staircase(Section):
    """The rate is multiplied by `factor` after every `every` steps."""

    kind: Literal["staircase"]
    every: PositiveInt
    factor: Annotated[float, Field(gt=0.0, le=1.0)] = 0.1


class TrainConfig(Section):
    """What every network's run has: how many steps of how many samples, how it learns, what it starts from.

    `ema` is the decay per step of the moving average of the weights, 0 for none; `clip` is the largest norm that a
    gradient keeps, 0 for any. `initial` is the file of weights to start from; its path counts from the folder in which
    the command runs, as all paths of the file do.
    """

    seed: NonNegativeInt = 1
    steps: PositiveInt = 8000
    batch: Annotated[int, Field(ge=2)] = 96
    check_every: PositiveInt = 800
    ema: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.998
    clip: Annotated[float, Field(ge=0.0)] = 5.0
    initial: str | None = None
    optimiser: Annotated[AdamW | Sgd, Field(discriminator="kind")] = AdamW()
    schedule: Annotated[Cosine | Staircase, Field(discriminator="kind")] = Cosine()

    @property
    def recorded(self) -> dict[str, Any]:
        """The whole configuration in plain types, defaults included."""
        return self.model_dump(mode="json")


class Frames(Section):
    """Labelled frames of one's own: a path and the format of its labels."""

    path: str
    format: str = "auto"


class NetworkSize(Section):
    """How large the network is, as `alexnet.Shape` tells; the pictures that it is shown are of the same `size`."""

    size: Annotated[int, Field(ge=63)] = 112
    width: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    hidden: PositiveInt = 512

    @property
    def shape(self) -> Shape:
        """The same for the network."""
        return Shape(self.size, self.width, self.hidden)


class PatchData(Section):
    """Where patches come from, and which share of each batch is real: `final_real_share` in the last third.

    Real frames are the project's own splits; or those of `train`, which are validated with those of `validation`, or
    with about `validation_share` of their drives where there are none. Of videos every `between`-th frame between two
    labelled ones is trained on, too, as `datasets.between` labels it; 0: none.
    """

    rendered_scenes: NonNegativeInt = 4000
    validation_scenes: PositiveInt = 50
    real_share: Share = 0.25
    final_real_share: Share = 0.5
    between: NonNegativeInt = 5
    train: tuple[Frames, ...] = ()
    validation: tuple[Frames, ...] = ()
    validation_share: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.2

    @checked(mode="after")
    def _has_something(self) -> Self:
        if self.rendered_scenes == 0 and min(self.real_share, self.final_real_share) < 1.0:
            raise ValueError("without rendered scenes real_share and final_real_share must be 1")
        if self.train and not self.wants_real:
            raise ValueError("with frames to train on real_share or final_real_share must be more than 0")
        if self.validation and not self.train:
            raise ValueError("there are frames for validation and none to train on: add [[data.train]]")
        return self

    @property
    def labelling(self) -> Between | None:
        """What labels frames between labelled ones, None where none are wanted."""
        return Between(self.between) if self.between else None

    @property
    def wants_real(self) -> bool:
        """Whether any batch holds real patches."""
        return max(self.real_share, self.final_real_share) > 0.0


class ClassifierData(PatchData):
    """Where a classifier's patches come from.

    `guide` is the ONNX file of a regressor: candidates are proposed as they are where both are served. Without it they
    are proposed as they are without a regressor.
    """

    guide: str | None = None


class Light(Section):
    """How often what happens to a picture's light and in the camera: shares of the pictures."""

    exposure: Share = 1.0
    shadow: Share = 0.33
    glare: Share = 0.08
    night: Share = 0.08
    rain: Share = 0.08
    blur: Share = 1.0
    grain: Share = 1.0
    lost: Share = 0.05
    jpeg: Share = 0.15


class Augmentation(Section):
    """What patches are varied by. `flip` is a share of all and `shear` one of the false patches.

    `jitter` is how far the top and the bottom of a patch move sideways at most, as a share of its width.
    """

    flip: Share = 0.5
    jitter: Annotated[float, Field(ge=0.0, le=0.05)] = 0.013
    shear: Share = 0.1
    light: Light = Light()


class ClassifierConfig(TrainConfig):
    """The classifier's run."""

    label_smoothing: Share = 0.05
    network: NetworkSize = NetworkSize()
    data: ClassifierData = ClassifierData()
    augmentation: Augmentation = Augmentation()


C = TypeVar("C", bound=TrainConfig)


def read_config(path: Path, kind: type[C]) -> C:
    """The configuration in the TOML file at `path`, or the shipped one of that name.

    Raises SettingsError with one line that names the file, the key and what is accepted.
    """
    shipped = SHIPPED / f"{path}.toml"
    file = shipped if not path.exists() and shipped.is_file() else path
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        names = ", ".join(sorted(found.stem for found in SHIPPED.glob("*.toml")))
        raise SettingsError(f"can't read {path}: {error.strerror}", f"give a TOML file, or one of {names}") from error
    except ValueError as error:  # not TOML, or not UTF-8
        raise SettingsError(f"{path} is not a TOML file: {error}", "write it as `key = value`, a line each") from error
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        raise _told(path, kind, error) from None


def _told(path: Path, kind: type[BaseModel], error: ValidationError) -> SettingsError:
    """The first thing that is wrong, in one line."""
    first = error.errors(include_url=False)[0]
    keys, section = _followed(kind, first["loc"])
    key = ".".join(keys) or "the file"
    if first["type"] == "extra_forbidden":
        return SettingsError(f"{path}: there is no {key}", f"accepted here: {', '.join(section.model_fields)}")
    if first["type"] == "value_error":
        return SettingsError(f"{path}: {key}: {first['ctx']['error']}")
    return SettingsError(f"{path}: {key} = {first['input']!r} is not accepted", first["msg"])


def _followed(kind: type[BaseModel], place: Sequence[str | int]) -> tuple[list[str], type[BaseModel]]:
    """The keys along `place`, as they stand in the file, and the section that the last one is in."""
    keys: list[str] = []
    section, inside = kind, {"": kind}
    for part in place:
        if isinstance(part, int):
            keys[-1] += f"[{part}]"
        elif "" not in inside and part in inside:  # the kind of a section, not a key
            inside = {"": inside[part]}
        else:
            section = inside.get("", section)
            keys.append(part)
            field = section.model_fields.get(part)
            inside = _sections(field.annotation) if field else {}
    return keys, section


def _sections(annotation: object) -> dict[str, type[BaseModel]]:
    """The sections that a field may hold, by their kind; the one without kinds by the empty string."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        field = annotation.model_fields.get("kind")
        return {(get_args(field.annotation)[0] if field else ""): annotation}
    return {name: kind for part in get_args(annotation) for name, kind in _sections(part).items()}
