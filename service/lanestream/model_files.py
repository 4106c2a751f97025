"""The command `models`: what model files say about themselves, as a table or as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import click
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR
from lanestream.inference.loading import load_model

_CARD: Final = SHIPPED_MODEL.with_name("MODEL_CARD.md")
# Without a terminal, lines are this wide, so that paths are not broken.
_PIPE_WIDTH: Final = 400


@dataclass(frozen=True)
class ModelFile:
    """A model file: its metadata, its size in bytes, and the SHA-256 of its bytes in hexadecimal.

    `default` is the option whose default it is, `--model` or `--regressor`, or None. `card` is the path of the model
    card of a shipped file, or None.
    """

    file: str
    name: str
    version: str
    kind: str
    precision: str
    bytes: int
    sha256: str
    default: str | None
    card: str | None


def describe_models(files: Sequence[Path] = ()) -> list[ModelFile]:
    """Returns what the model `files` say about themselves, by default the shipped ones. Raises ModelError."""
    shipped = sorted(SHIPPED_MODEL.parent.glob("*.onnx"))
    return [_describe(path, is_shipped=path.resolve() in shipped) for path in files or shipped]


def print_models(models: Sequence[ModelFile], *, as_json: bool) -> None:
    """Prints a table, or one JSON document."""
    if as_json:
        click.echo(json.dumps({"models": [asdict(model) for model in models]}, indent=2))
        return
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = _PIPE_WIDTH
    table = Table(box=box.SIMPLE_HEAD, show_edge=False)
    for heading in ("model", "kind", "precision", "size", "default of", "file", "sha256"):
        table.add_column(heading, overflow="fold")
    for model in models:
        size = f"{model.bytes / 1e6:.1f} MB"
        cells = f"{model.name} {model.version}", model.kind, model.precision, size, model.default or "", model.file
        table.add_row(*map(Text, cells), Text(model.sha256))
    console.print(table)
    for card in sorted({model.card for model in models if model.card is not None}):
        click.echo(f"\nmodel card: {card}")


def _describe(path: Path, *, is_shipped: bool) -> ModelFile:
    model = load_model(path, "cpu")
    defaults = {SHIPPED_MODEL: "--model", SHIPPED_REGRESSOR: "--regressor"}
    return ModelFile(
        file=str(path),
        name=model.info.name,
        version=model.info.version,
        kind=model.info.kind,
        precision=model.info.precision,
        bytes=path.stat().st_size,
        sha256=model.sha256,
        default=defaults.get(path.resolve()),
        card=str(_CARD) if is_shipped else None,
    )
