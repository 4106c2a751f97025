"""Files with one JSON object a line, read with the place of each object, so that a bad one can be named."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lanestream.errors import LabelError, LanestreamError

_ACCEPTED = "one JSON object a line is accepted"


def records(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """(place, object) for each line of `path`, the place as `file:line`. Raises LabelError that names the place."""
    for place, record in all_records(path):
        if isinstance(record, LabelError):
            raise record
        yield place, record


def all_records(path: Path) -> Iterator[tuple[str, dict[str, Any] | LabelError]]:
    """As `records`, but a bad line is yielded as its error, and those after it still come. Raises nothing."""
    try:
        lines = text_of(path).splitlines()
    except LabelError as error:
        yield str(path), error
        return
    for number, line in enumerate(lines, start=1):
        place = f"{path}:{number}"
        try:
            yield place, json_object(line, place, _ACCEPTED)
        except LabelError as error:
            yield place, error


def text_of(path: Path, accepted: str = _ACCEPTED) -> str:
    """What the text file `path` says. Raises LabelError where it can't be read or is no text."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise LabelError(f"can't read {path}: {(error.strerror or str(error)).lower()}") from None
    except UnicodeDecodeError:
        raise LabelError(f"{path} is not a text file", accepted) from None


def json_object(text: str, place: str, accepted: str) -> dict[str, Any]:
    """The JSON object that `text` is. Raises LabelError that names the `place` and what is `accepted` there."""
    try:
        found = json.loads(text)
    except json.JSONDecodeError as error:
        raise LabelError(f"{place}: not JSON: {error.msg}", accepted) from None
    except (RecursionError, ValueError):
        raise LabelError(f"{place}: not JSON that can be read: too deep, or a number too long", accepted) from None
    if not isinstance(found, dict):
        raise LabelError(f"{place}: not a JSON object", accepted)
    return found


def placed(place: str, error: LanestreamError) -> LabelError:
    """`error` as the error of the record at `place`."""
    return LabelError(f"{place}: {error.message}", error.hint)


def unusable(place: str, error: Exception, needed: str) -> LabelError:
    """The error for an object whose fields are missing or of another kind than `needed`."""
    why = f"there is no {error}" if isinstance(error, KeyError) else str(error)
    return LabelError(f"{place}: {why}", f"a record needs {needed}")
