"""What a model file says of itself: the one metadata entry that makes it servable."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from lanestream.detection.regression_detector import OUTPUTS
from lanestream.errors import ModelError

METADATA_KEY: Final = "lanestream"


class PatchInfo(BaseModel):
    """How the strips were cut that a classifier was trained on; see `geometry.PatchGeometry`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    size: int = Field(gt=0)
    half_width: float = Field(gt=0.0)
    min_half_width: float = Field(gt=0.0)
    lean: float = Field(default=0.0, ge=0.0)


class RoadCropInfo(BaseModel):
    """The canonical picture that a regressor was trained on; see `geometry.RoadCropGeometry`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    size: int = Field(gt=0)
    above: float = Field(ge=0.0)
    narrowest: float = Field(gt=0.0, le=1.0)
    detail_width: int = Field(gt=0)


class _Description(BaseModel):
    """What every model file says of itself."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    version: str
    channels: Literal["RGB"] = "RGB"
    threshold: float = Field(gt=0.0, lt=1.0)
    precision: Literal["fp32", "fp16", "int8"]
    training: dict[str, Any] = Field(description="What it was trained on, and how far.")
    metrics: dict[str, Any] = Field(description="What it measured on validation frames when it was exported.")
    exporter: str


class ClassifierInfo(_Description):
    """A network that tells boundaries among patches; `temperature` is already applied in the graph."""

    kind: Literal["classifier"]
    classes: tuple[str, ...]
    strip: PatchInfo
    temperature: float = Field(gt=0.0)

    @property
    def input_size(self) -> int:
        """The width and height of an input in pixels."""
        return self.strip.size

    @property
    def outputs(self) -> int:
        """How many numbers it answers for an input."""
        return len(self.classes)


class RegressorInfo(_Description):
    """A network that tells the ego lane's boundaries from a canonical picture; see `detection.regression`."""

    kind: Literal["regressor"]
    canvas: RoadCropInfo

    @property
    def input_size(self) -> int:
        """The width and height of an input in pixels."""
        return self.canvas.size

    @property
    def outputs(self) -> int:
        """How many numbers it answers for an input."""
        return OUTPUTS


ModelInfo = ClassifierInfo | RegressorInfo

_ADAPTER: Final[TypeAdapter[ModelInfo]] = TypeAdapter(Annotated[ModelInfo, Field(discriminator="kind")])


def require_file(path: Path) -> None:
    """Raises ModelError where there is no file at `path`."""
    if not path.is_file():
        raise ModelError(f"no model file at {path}", "give the path of an exported .onnx file")


def parse_info(metadata: dict[str, str], source: str) -> ModelInfo:
    """The description among a model's metadata. Raises ModelError where it is missing or not understood."""
    hint = "export it with `lanestream export CHECKPOINT OUT.onnx`"
    if METADATA_KEY not in metadata:
        raise ModelError(f"{source} does not describe itself: no '{METADATA_KEY}' metadata", hint)
    try:
        return _ADAPTER.validate_json(metadata[METADATA_KEY])
    except ValidationError as error:
        problem = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in problem["loc"]) or METADATA_KEY
        raise ModelError(
            f"{source} has a description that is not understood: {where}: {problem['msg']}", hint
        ) from None
