"""Reads TOML files into pydantic models and reports the first mistake in one line."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lanestream.errors import SettingsError

# The recipes and the data set manifest that are shipped with the package.
CONFIG_FOLDER: Final = Path(__file__).parent / "configs"

# A share of a whole, from 0 to 1.
Share = Annotated[float, Field(ge=0.0, le=1.0)]

# The keys whose value says which of several sections a table is.
_TAGS: Final = ("kind", "by")


class Section(BaseModel):
    """A table of a TOML file. Unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


S = TypeVar("S", bound=Section)


def read_toml(path: Path, model: type[S], hint: str) -> S:
    """Returns the TOML file at `path` as a `model`; `hint` says what to give if the file can't be read.

    Raises SettingsError with one line that names the file, the key and what is accepted.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsError(f"can't read {path}: {(error.strerror or str(error)).lower()}", hint) from error
    except ValueError as error:  # not TOML, or not UTF-8
        raise SettingsError(f"{path} is not a TOML file: {error}", "write one `key = value` per line") from error
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise _settings_error(path, model, error) from None


def _settings_error(path: Path, model: type[BaseModel], error: ValidationError) -> SettingsError:
    first = error.errors(include_url=False)[0]
    keys, section = _locate(model, first["loc"])
    key = ".".join(keys)
    accepted = f"accepted here: {', '.join(section.model_fields)}"
    if first["type"] == "extra_forbidden":
        return SettingsError(f"{path}: unknown key {key}", accepted)
    if first["type"] == "missing":
        return SettingsError(f"{path}: the key {key} is missing", accepted)
    if first["type"] == "value_error":
        return SettingsError(f"{path}: {key}: {first['ctx']['error']}" if key else f"{path}: {first['ctx']['error']}")
    return SettingsError(f"{path}: {key} = {first['input']!r} is not accepted", first["msg"])


def _locate(model: type[BaseModel], location: Sequence[str | int]) -> tuple[list[str], type[BaseModel]]:
    """Returns the keys along pydantic's `location` as the file writes them, and the section that holds the last."""
    keys: list[str] = []
    section, inside = model, {"": model}
    for part in location:
        if isinstance(part, int):
            keys[-1] += f"[{part}]"
        elif "" not in inside and part in inside:  # the tag of a section, not a key
            inside = {"": inside[part]}
        else:
            section = inside.get("", section)
            keys.append(part)
            field = section.model_fields.get(part)
            inside = _sections(field.annotation) if field else {}
    return keys, section


def _sections(annotation: object) -> dict[str, type[BaseModel]]:
    """Returns the sections that a field may hold, by their tag; a section without a tag has the empty string."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        tags = [annotation.model_fields[name] for name in _TAGS if name in annotation.model_fields]
        return {(get_args(tags[0].annotation)[0] if tags else ""): annotation}
    return {tag: section for part in get_args(annotation) for tag, section in _sections(part).items()}
