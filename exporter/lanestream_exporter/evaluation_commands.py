"""The commands `evaluate` and `score`."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click
from rich.console import Console

from lanestream.engine import SHIPPED_MODEL, load_engine, resolve_regressor
from lanestream.errors import ModelError, SourceError, needs_extra
from lanestream_exporter.datasets.files import DataFolder
from lanestream_exporter.datasets.formats import AUTO, FORMATS, format_of
from lanestream_exporter.datasets.manifest import DatasetCollection
from lanestream_exporter.datasets.reading import read_dataset
from lanestream_exporter.evaluation.baselines import HoughLinesBaseline, SlidingWindowBaseline
from lanestream_exporter.evaluation.measuring import EvaluationSet, run_evaluation
from lanestream_exporter.evaluation.methods import Baseline, Method, ServedModel
from lanestream_exporter.evaluation.score import score_results
from lanestream_exporter.evaluation.tables import figure_tables

if TYPE_CHECKING:
    from lanestream_exporter.datasets.splits import Split

_REGRESSOR: Final = "Regressor whose ego-lane prior the classifiers use, or `none`.  [default: the shipped one]"
_MIN_WIDTH: Final = 100  # columns of the tables, even if the terminal has fewer


@click.command()
@click.option(
    "--model",
    "models",
    type=click.Path(path_type=Path),
    multiple=True,
    default=[SHIPPED_MODEL],
    help="ONNX file; may be repeated.  [default: the shipped classifier]",
)
@click.option("--regressor", type=click.Path(path_type=Path), help=_REGRESSOR)
@click.option("--split", type=click.Choice(["train", "val", "test"]), default="test", show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="Folder that report.html is written to.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write all figures to this file.")
@click.option(
    "--data",
    type=click.Path(path_type=Path),
    help="Labeled frames, or the folder that the paths of the manifest count from.  [default: $LANESTREAM_DATA]",
)
@click.option(
    "--manifest", type=click.Path(path_type=Path), help="Manifest of the data sets that --split is of."
    "  [default: the shipped one]",
)  # fmt: skip
@click.option(
    "--format", "format_name", type=click.Choice([AUTO, *FORMATS]), default=AUTO, help="The format of your labels."
)
def evaluate(
    models: Sequence[Path],
    regressor: Path | None,
    split: Split,
    out: Path | None,
    json_path: Path | None,
    data: Path | None,
    manifest: Path | None,
    format_name: str,
) -> None:
    """Evaluate model files and two classical baselines on labeled frames.

    Figures are for candidates (level A), boundaries of single images and of clips (B), and the field's metrics (C);
    docs/evaluation.md describes each. A folder of labeled frames given with --data is evaluated as single images.
    """
    evaluation_set = _evaluation_set(data, manifest, format_name, split)
    evaluation = run_evaluation(
        _methods(models, regressor), evaluation_set, lambda stage: click.echo(f"measuring {stage} ...", err=True)
    )
    figures = evaluation.figures()
    console = Console(width=max(_MIN_WIDTH, Console().width))
    for table in figure_tables(figures):
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
    """Evaluate RESULTS, a file that `stream --jsonl` wrote, against the LABELS of the clip."""
    click.echo(json.dumps(score_results(results, labels), indent=2))


def _evaluation_set(data: Path | None, manifest: Path | None, format_name: str, split: Split) -> EvaluationSet:
    """Returns a split of the manifest, or all labeled frames in `data` if it has none of the shipped data sets."""
    datasets = DatasetCollection.open(manifest, data)
    if data is None or manifest is not None or (format_name == AUTO and datasets.any_present):
        return EvaluationSet.of_split(datasets, split)
    name = format_of(DataFolder.at(data), format_name)
    return EvaluationSet(data.name, lambda: read_dataset(data, name))


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise SourceError(f"can't write {path}: {(error.strerror or str(error)).lower()}") from None


def _methods(models: Sequence[Path], regressor: Path | None) -> list[Method]:
    regressor_file = resolve_regressor(regressor)
    ours = [ServedModel(load_engine(path, "cpu", regressor_file)) for path in models]
    methods: list[Method] = [*ours, Baseline(HoughLinesBaseline()), Baseline(SlidingWindowBaseline())]
    names = [method.name for method in methods]
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise ModelError(f"two of the models are named {repeated!r}", "give models of different names or versions")
    return methods
