"""The command `score`."""

from __future__ import annotations

import json
from pathlib import Path

import click


@click.command()
@click.argument("results", type=click.Path(path_type=Path))
@click.argument("labels", type=click.Path(path_type=Path))
def score(results: Path, labels: Path) -> None:
    """Evaluate RESULTS, a file that `stream --jsonl` wrote, against the LABELS of the clip."""
    from lanestream_exporter.evaluation.score import score_results

    click.echo(json.dumps(score_results(results, labels), indent=2))
