"""The commands `evaluate` and `score`."""

from __future__ import annotations

import json
from pathlib import Path

import click

from lanestream.engine import SHIPPED_MODEL, load_engine
from lanestream_exporter.datasets.splits import data_root
from lanestream_exporter.evaluation.measuring import Evaluation
from lanestream_exporter.evaluation.score import score as measured

_DATA = click.option(
    "--data", type=click.Path(path_type=Path), help="Folder of real frames [default: $LANESTREAM_DATA]."
)


@click.command()
@click.option("--model", type=click.Path(path_type=Path), default=SHIPPED_MODEL, show_default="the shipped one")
@click.option("--split", type=click.Choice(["train", "val", "test"]), default="test", show_default=True)
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Also write the figures to this file.")
@_DATA
def evaluate(model: Path, split: str, json_path: Path | None, data: Path | None) -> None:
    """Measure a model file on the labelled real frames of a split.

    Prints candidates (precision, recall, accuracy, proposal recall), and boundaries of single images and of clips.
    """
    root = data_root(data)
    engine = load_engine(model, "cpu")
    evaluation = Evaluation(engine)
    figures = {
        "model": engine.network.name,
        "split": split,
        "images": evaluation.images(root, split),  # type: ignore[arg-type]  # click has checked it
        "clips": evaluation.clips(root, split),  # type: ignore[arg-type]
    }
    text = json.dumps(figures, indent=2)
    click.echo(text)
    if json_path is not None:
        json_path.parent.mkdir(parents=True, exist_ok=True)
        json_path.write_text(text + "\n")


@click.command()
@click.argument("results", type=click.Path(path_type=Path))
@click.argument("labels", type=click.Path(path_type=Path))
def score(results: Path, labels: Path) -> None:
    """Measure RESULTS, a file that `stream --jsonl` wrote, against the LABELS of the clip."""
    click.echo(json.dumps(measured(results, labels), indent=2))
