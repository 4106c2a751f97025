"""The commands `evaluate` and `evaluate tracking`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from click.core import ParameterSource
from rich.console import Console

from lanestream.errors import ModelError, needs_extra
from lanestream.writing import check_file, check_folder, writing
from lanestream_exporter.choices import CLIP_KINDS, LABEL_FORMATS
from lanestream_exporter.label_option import LABEL_MAP

if TYPE_CHECKING:
    from lanestream_exporter.datasets.splits import Split
    from lanestream_exporter.evaluation.measuring import EvaluationSet
    from lanestream_exporter.evaluation.methods import Method

_REGRESSOR: Final = "Regressor whose ego-lane prior the classifiers use, `shipped` or `none`.  [default: shipped]"
# Columns of the tables, even if the terminal has fewer.
_MIN_WIDTH: Final = 130
_MIN_TRACKING_WIDTH: Final = 150


@click.group(invoke_without_command=True)
@click.option(
    "--model",
    "models",
    type=click.Path(path_type=Path),
    multiple=True,
    default=[Path("shipped")],
    help="ONNX file, or `shipped`; may be repeated.  [default: shipped]",
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
    "--format", "format_name", type=click.Choice(LABEL_FORMATS), default="auto", help="The format of your labels."
)
@LABEL_MAP
@click.option(
    "--labels-only", is_flag=True,
    help="Leave out the pictures without a road, the rendered towns and the stills.",
)  # fmt: skip
@click.pass_context
def evaluate(
    context: click.Context,
    models: Sequence[Path],
    regressor: Path | None,
    split: Split,
    out: Path | None,
    json_path: Path | None,
    data: Path | None,
    manifest: Path | None,
    format_name: str,
    labels: tuple[str, ...],
    labels_only: bool,
) -> None:
    """Evaluate model files and two classical baselines on labeled frames.

    Figures are for candidates (level A), boundaries of single images and of clips (B), the field's metrics (C),
    pictures without a road, rendered towns, and stills; docs/evaluation.md describes each. A folder of labeled frames
    given with --data is evaluated as single images.
    """
    if context.invoked_subcommand is not None:
        _refuse_options(context)
        return
    from lanestream_exporter.evaluation.measuring import NO_EXTRAS, USUAL_EXTRAS, run_evaluation
    from lanestream_exporter.evaluation.tables import figure_tables

    _check_targets(out, json_path)
    evaluation_set = _evaluation_set(data, manifest, format_name, labels, split)
    evaluation = run_evaluation(
        _methods(models, regressor),
        evaluation_set,
        lambda stage: click.echo(f"measuring {stage} ...", err=True),
        NO_EXTRAS if labels_only else USUAL_EXTRAS,
    )
    figures = evaluation.figures()
    console = Console(width=max(_MIN_WIDTH, Console().width))
    for line in figures["verdicts"]:
        click.echo(line)
    for table in figure_tables(figures):
        console.print(table)
    if out is not None:
        with needs_extra("train"), writing(out):
            from lanestream_exporter.evaluation.report import write_report

            click.echo(f"report: {write_report(out, evaluation, figures)}")
    if json_path is not None:
        _write_json(json_path, figures)


@evaluate.command("tracking")
@click.option(
    "--rendered", "clips", type=click.IntRange(0), default=24, show_default=True, help="Rendered clips of each kind."
)
@click.option(
    "--seeds", "first_seed", type=click.IntRange(0), default=1000, show_default=True, metavar="FIRST",
    help="Seed of the first clip of each kind; no choice is made on those from 1000 on.",
)  # fmt: skip
@click.option(
    "--kind", "kinds", type=click.Choice(CLIP_KINDS), multiple=True, metavar="KIND",
    help=f"Kind of rendered clips; may be repeated: {', '.join(CLIP_KINDS)}.  [default: all]",
)  # fmt: skip
@click.option("--calibrate", is_flag=True, help="Let the systems estimate the camera's pitch and yaw.")
@click.option("--real", is_flag=True, help="Evaluate the labeled real clips of the manifest, too.")
@click.option("--held-out", is_flag=True, help="With --real: also the frames that no choice was made on.")
@click.option("--model", type=click.Path(path_type=Path), help="ONNX file, or `shipped`.  [default: shipped]")
@click.option(
    "--against", type=click.Path(path_type=Path), metavar="CHECKOUT",
    help="Source tree of this project to compare with, of any version since 0.9.0.",
)  # fmt: skip
@click.option("--against-model", type=click.Path(path_type=Path), help="ONNX file to compare with, or for --against.")
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True, help="Processes for rendered clips.")
@click.option("-o", "--out", type=click.Path(path_type=Path), help="Write all figures to this JSON file.")
@click.option("--plots", type=click.Path(path_type=Path), metavar="DIR", help="Write plots of rendered clips to DIR.")
@click.option(
    "--data", type=click.Path(path_type=Path),
    help="Folder that the paths of the manifest count from.  [default: $LANESTREAM_DATA]",
)  # fmt: skip
@click.option("--manifest", type=click.Path(path_type=Path), help="Manifest of real clips.  [default: the shipped one]")
def evaluate_tracking(
    clips: int,
    first_seed: int,
    kinds: tuple[str, ...],
    calibrate: bool,
    real: bool,
    held_out: bool,
    model: Path | None,
    against: Path | None,
    against_model: Path | None,
    jobs: int,
    out: Path | None,
    plots: Path | None,
    data: Path | None,
    manifest: Path | None,
) -> None:
    """Measure tracking on rendered clips with exact truth, and on real clips.

    With --against or --against-model, two systems get the same frames: this code with --model, and the other one.
    docs/evaluation.md describes each figure.
    """
    from lanestream_exporter.datasets.manifest import DatasetCollection
    from lanestream_exporter.evaluation.tracking.figures import all_figures
    from lanestream_exporter.evaluation.tracking.real import real_clips, run_real
    from lanestream_exporter.evaluation.tracking.rendered import RenderedSet, run_rendered
    from lanestream_exporter.evaluation.tracking.systems import AGAINST, PRESENT, SystemSpec
    from lanestream_exporter.evaluation.tracking.tables import tracking_tables

    _check_targets(plots, out)
    specs = [SystemSpec(PRESENT, None, model)]
    if against is not None or against_model is not None:
        specs.append(SystemSpec(AGAINST, against, against_model))
    rendered = RenderedSet(kinds or CLIP_KINDS, range(first_seed, first_seed + clips), calibrate)
    systems = {spec.name: spec.describe() for spec in specs}
    real_set = real_clips(DatasetCollection.open(manifest, data), held_out) if real else []
    runs = run_rendered(specs, rendered, jobs, _progress)
    figures = all_figures(systems, rendered, runs, run_real(specs, real_set, _progress))
    console = Console(width=max(_MIN_TRACKING_WIDTH, Console().width))
    for table in tracking_tables(figures):
        console.print(table)
    if out is not None:
        _write_json(out, figures)
    if plots is not None and rendered.clips:
        with needs_extra("train"), writing(plots):
            from lanestream_exporter.evaluation.tracking.plots import write_plots

            write_plots(plots, figures, runs)


def _evaluation_set(
    data: Path | None, manifest: Path | None, format_name: str, labels: tuple[str, ...], split: Split
) -> EvaluationSet:
    """Returns a split of the manifest, or all labeled frames in `data` if it has none of the shipped data sets."""
    from lanestream_exporter.datasets.files import DataFolder
    from lanestream_exporter.datasets.formats import AUTO, format_of
    from lanestream_exporter.datasets.label_map import LabelMap
    from lanestream_exporter.datasets.manifest import DatasetCollection
    from lanestream_exporter.datasets.reading import read_dataset
    from lanestream_exporter.evaluation.measuring import EvaluationSet

    datasets = DatasetCollection.open(manifest, data)
    if data is None or manifest is not None or (format_name == AUTO and datasets.any_present):
        if labels:
            raise click.UsageError("--label is for a folder of your own; a manifest has `labels`")
        return EvaluationSet.of_split(datasets, split)
    name, label_map = format_of(DataFolder.at(data), format_name), LabelMap.of(labels)
    return EvaluationSet(data.name, lambda: read_dataset(data, name, label_map))


def _refuse_options(context: click.Context) -> None:
    """Raises UsageError if options of `evaluate` itself were given before a subcommand, which does not use them."""
    for option in context.command.params:
        if option.name and context.get_parameter_source(option.name) is ParameterSource.COMMANDLINE:
            problem = f"{option.opts[-1]} is an option of `evaluate`, not of `evaluate {context.invoked_subcommand}`"
            raise click.UsageError(problem, context)


def _progress(stage: str) -> None:
    click.echo(f"measured {stage}", err=True)


def _write_json(path: Path, figures: Mapping[str, Any]) -> None:
    with writing(path):
        path.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


def _check_targets(folder: Path | None, file: Path | None) -> None:
    """Raises SourceError if one of the targets can't be written: the evaluation takes long."""
    if folder is not None:
        check_folder(folder)
    if file is not None:
        check_file(file)


def _methods(models: Sequence[Path], regressor: Path | None) -> list[Method]:
    from lanestream.engine import load_engine, resolve_regressor
    from lanestream_exporter.evaluation.baselines import HoughLinesBaseline, SlidingWindowBaseline
    from lanestream_exporter.evaluation.methods import Baseline, ServedModel

    regressor_file = resolve_regressor(regressor)
    ours = [ServedModel(load_engine(path, "cpu", regressor_file)) for path in models]
    methods: list[Method] = [*ours, Baseline(HoughLinesBaseline()), Baseline(SlidingWindowBaseline())]
    names = [method.name for method in methods]
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise ModelError(f"two of the models are named {repeated!r}", "give models of different names or versions")
    return methods
