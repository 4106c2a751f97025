"""What a model file says of itself: the one metadata entry that makes it servable."""

from __future__ import annotations

from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lanestream.errors import ModelError

METADATA_KEY: Final = "lanestream"


class StripInfo(BaseModel):
    """How the strips were cut that the network was trained on; see `geometry.StripGeometry`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    size: int = Field(gt=0)
    half_width: float = Field(gt=0.0)
    min_half_width: float = Field(gt=0.0)


class ModelInfo(BaseModel):
    """A model file's description, written by the exporter and read before anything is run."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["classifier"]
    name: str
    version: str
    channels: Literal["RGB"] = "RGB"
    classes: tuple[str, ...]
    strip: StripInfo
    temperature: float = Field(gt=0.0, description="Already applied in the graph.")
    threshold: float = Field(gt=0.0, lt=1.0)
    precision: Literal["fp32", "fp16", "int8"]
    training: dict[str, Any] = Field(description="What it was trained on, and how far.")
    metrics: dict[str, Any] = Field(description="What it measured on validation patches when it was exported.")
    exporter: str

    @classmethod
    def parse(cls, metadata: dict[str, str], source: str) -> ModelInfo:
        """The description among a model's metadata. Raises ModelError where it is missing or not understood."""
        hint = "export it with `lanestream export CHECKPOINT OUT.onnx`"
        if METADATA_KEY not in metadata:
            raise ModelError(f"{source} does not describe itself: no '{METADATA_KEY}' metadata", hint)
        try:
            return cls.model_validate_json(metadata[METADATA_KEY])
        except ValidationError as error:
            problem = error.errors(include_url=False, include_input=False)[0]
            where = ".".join(str(part) for part in problem["loc"]) or METADATA_KEY
            raise ModelError(
                f"{source} has a description that is not understood: {where}: {problem['msg']}", hint
            ) from None
