"""The commands `evaluate` and `score`."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click
from rich.console import Console

from lanestream.engine import SHIPPED_MODEL, load_engine, resolve_regressor
from lanestream.errors import LabelError, ModelError, SourceError, needs_extra
from lanestream_exporter.datasets.folder import DataFolder
from lanestream_exporter.datasets.formats import FORMATS
from lanestream_exporter.datasets.reading import form_of, read_dataset
from lanestream_exporter.datasets.splits import data_root
from lanestream_exporter.evaluation.baselines import HoughLinesBaseline, SlidingWindowBaseline
from lanestream_exporter.evaluation.measuring import Material
from lanestream_exporter.evaluation.measuring import evaluate as measure
from lanestream_exporter.evaluation.methods import Baseline, Method, ServedModel
from lanestream_exporter.evaluation.score import score as measured
from lanestream_exporter.evaluation.tables import tables

if TYPE_CHECKING:
    from lanestream_exporter.datasets.splits import Split

_REGRESSOR: Final = "Regressor that shows classifiers where to look, or `none`.  [default: the shipped one]"
_NARROWEST: Final = 100  # columns of the tables, also where the terminal has fewer


@click.command()
@click.option(
    "--model",
    "models",
    type=click.Path(path_type=Path),
    multiple=True,
    default=[SHIPPED_MODEL],
    help="ONNX file; give it again for another one.  [default: the shipped classifier]",
)
@click.option("--regressor", type=click.Path(path_type=Path), help=_REGRESSOR)
@click.option("--split", type=click.Choice(["train", "val", "test"]), default="test", show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="Folder that report.html is written to.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write all figures to this file.")
@click.option(
    "--data",
    type=click.Path(path_type=Path),
    help="Labelled frames of your own, or the folder of real frames that --split is of.  [default: $LANESTREAM_DATA]",
)
@click.option(
    "--format", "form", type=click.Choice(["auto", *FORMATS]), default="auto", help="The form of your labels."
)
def evaluate(
    models: Sequence[Path],
    regressor: Path | None,
    split: Split,
    out: Path | None,
    json_path: Path | None,
    data: Path | None,
    form: str,
) -> None:
    """Measure model files and two classical baselines on labelled frames.

    Candidates (level A), boundaries of single images and of clips (B), and the field's metrics (C); docs/evaluation.md
    describes every figure. Your own frames are measured as single images, all of them.
    """
    material = _material(data, form, split)
    evaluation = measure(
        _methods(models, regressor), material, lambda stage: click.echo(f"measuring {stage} ...", err=True)
    )
    figures = evaluation.figures()
    console = Console(width=max(_NARROWEST, Console().width))
    for table in tables(figures):
        console.print(table)
    if out is not None:
        with needs_extra("train"), _writing(out):
            from lanestream_exporter.evaluation.report import write_report

            click.echo(f"report: {write_report(out, evaluation, figures)}")
    if json_path is not None:
        with _writing(json_path):
            json_path.parent.mkdir(parents=True, exist_ok=True)
            json_path.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


@click.command()
@click.argument("results", type=click.Path(path_type=Path))
@click.argument("labels", type=click.Path(path_type=Path))
def score(results: Path, labels: Path) -> None:
    """Measure RESULTS, a file that `stream --jsonl` wrote, against the LABELS of the clip."""
    click.echo(json.dumps(measured(results, labels), indent=2))


def _material(data: Path | None, form: str, split: Split) -> Material:
    """The project's split where `data` is its folder of real frames, else all that is labelled in `data`."""
    if data is None:
        return Material.of_split(data_root(), split)
    if form == "auto":
        with suppress(LabelError):
            return Material.of_split(data_root(data), split)
    told = form_of(DataFolder.at(data), form)
    return Material(data.name, lambda: read_dataset(data, told))


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise SourceError(f"can't write {path}: {(error.strerror or str(error)).lower()}") from None


def _methods(models: Sequence[Path], regressor: Path | None) -> list[Method]:
    guide = resolve_regressor(regressor)
    ours = [ServedModel(load_engine(path, "cpu", guide)) for path in models]
    methods: list[Method] = [*ours, Baseline(HoughLinesBaseline()), Baseline(SlidingWindowBaseline())]
    names = [method.name for method in methods]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ModelError(f"two of the models are named {twice!r}", "give models of different names or versions")
    return methods
