"""Files with one JSON object a line, read with the place of each object, so that a bad one can be named."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lanestream.errors import LabelError


def records(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """(place, object) for each line of `path`, the place as `file:line`. Raises LabelError that names the place."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise LabelError(f"can't read {path}: {(error.strerror or str(error)).lower()}") from None
    except UnicodeDecodeError:
        raise LabelError(f"{path} is not a text file", "one JSON object a line is accepted") from None
    for number, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
        except json.JSONDecodeError as error:
            raise LabelError(f"{path}:{number}: not JSON: {error.msg}", "one JSON object a line is accepted") from None
        if not isinstance(record, dict):
            raise LabelError(f"{path}:{number}: not a JSON object", "one JSON object a line is accepted")
        yield f"{path}:{number}", record


def unusable(place: str, error: Exception, needed: str) -> LabelError:
    """The error for an object whose fields are missing or of another kind than `needed`."""
    why = f"there is no {error}" if isinstance(error, KeyError) else str(error)
    return LabelError(f"{place}: {why}", f"a record needs {needed}")
