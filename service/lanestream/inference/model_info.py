"""The description in a model file: the metadata entry that serving needs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from lanestream.errors import ModelError
from lanestream.road.appearance import (
    BOUNDARY_KINDS,
    MARKING_COLORS,
    MARKING_TYPES,
    BoundaryKind,
    MarkingColor,
    MarkingType,
)
from lanestream.road.crops import PatchGeometry, RoadCropGeometry

METADATA_KEY: Final = "lanestream"
# Columns, their deviations, presences and the horizon; see `detection.ego_prior.RegressorOutput`.
_REGRESSOR_OUTPUTS: Final = 15
_SIDES: Final = 2


class _Description(BaseModel):
    """What every model file says about itself."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    version: str
    channels: Literal["RGB"] = "RGB"
    threshold: float = Field(gt=0.0, lt=1.0)
    precision: Literal["fp32", "fp16", "int8"]
    training: dict[str, Any] = Field(description="What it was trained on, and for how long.")
    metrics: dict[str, Any] = Field(description="What it measured on validation frames when it was exported.")
    exporter: str

    @model_validator(mode="before")
    @classmethod
    def _names_before_0_10(cls, data: Any) -> Any:
        """Reads files of versions before 0.10, which named the crops differently."""
        if isinstance(data, dict):
            data = {{"strip": "patch", "canvas": "road_crop"}.get(key, key): value for key, value in data.items()}
            if isinstance(data.get("patch"), dict):
                data["patch"] = {{"lean": "obliquity"}.get(key, key): value for key, value in data["patch"].items()}
        return data


class ClassifierInfo(_Description):
    """A network that recognizes boundaries on patches; its graph already applies the temperatures.

    Its outputs are the probabilities of the `classes`, then those of the `types` and `colors` of a marking. Networks
    before 0.13 have two classes, without and with a boundary, and no types or colors.
    """

    kind: Literal["classifier"]
    classes: tuple[str, ...] = Field(min_length=2, max_length=3)
    types: tuple[MarkingType, ...] = ()
    colors: tuple[MarkingColor, ...] = ()
    patch: PatchGeometry
    temperature: float = Field(gt=0.0)
    type_temperature: float = Field(default=1.0, gt=0.0)
    color_temperature: float = Field(default=1.0, gt=0.0)

    @property
    def input_size(self) -> int:
        """The width and height of an input in pixels."""
        return self.patch.size

    @property
    def outputs(self) -> int:
        """The number of outputs for one input."""
        return len(self.classes) + len(self.types) + len(self.colors)

    @model_validator(mode="after")
    def _check(self) -> Self:
        named = self.classes[1:], self.types, self.colors
        classifies_markings = named == (BOUNDARY_KINDS, MARKING_TYPES, MARKING_COLORS)
        if not classifies_markings and (len(self.classes) != 2 or self.types or self.colors):
            raise ValueError("its classes, types and colors are not those of this version or of an older one")
        return self


class RegressorInfo(_Description):
    """A network that finds the ego lane's boundaries on a road crop.

    `kinds` are the kinds of boundaries that it distinguishes; networks before 0.13 know only markings.
    """

    kind: Literal["regressor"]
    kinds: tuple[BoundaryKind, ...] = ("marking",)
    road_crop: RoadCropGeometry

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.kinds not in (BOUNDARY_KINDS[:1], BOUNDARY_KINDS):
            raise ValueError("its kinds are not those of this version or of an older one")
        return self

    @property
    def input_size(self) -> int:
        """The width and height of an input in pixels."""
        return self.road_crop.size

    @property
    def outputs(self) -> int:
        """The number of outputs for one input."""
        return _REGRESSOR_OUTPUTS + _SIDES * (len(self.kinds) - 1)


ModelInfo = ClassifierInfo | RegressorInfo

_ADAPTER: Final[TypeAdapter[ModelInfo]] = TypeAdapter(Annotated[ModelInfo, Field(discriminator="kind")])


def require_file(path: Path) -> None:
    """Raises ModelError if the file at `path` is missing or can't be read."""
    hint = "give the path of an exported .onnx file"
    try:
        if not path.is_file():
            raise ModelError(f"no model file at {path}", hint)
        path.open("rb").close()
    except OSError as error:
        raise ModelError(f"can't read {path}: {(error.strerror or str(error)).lower()}", hint) from None


def parse_info(metadata: dict[str, str], source: str) -> ModelInfo:
    """Returns the description in a model's metadata. Raises ModelError if it is missing or invalid."""
    hint = "export it with `lanestream export CHECKPOINT OUT.onnx`"
    if METADATA_KEY not in metadata:
        raise ModelError(f"{source} does not describe itself: it has no '{METADATA_KEY}' metadata", hint)
    try:
        return _ADAPTER.validate_json(metadata[METADATA_KEY])
    except ValidationError as error:
        problem = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in problem["loc"]) or METADATA_KEY
        raise ModelError(f"{source} has an invalid description: {where}: {problem['msg']}", hint) from None
