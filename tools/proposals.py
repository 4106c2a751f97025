"""Proposal recall against the number of candidates, step by step of the search: what each step is worth."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from lanestream.detection import answered
from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.ego_prior import EgoPriorEstimator
from lanestream.detection.proposals import CandidateSearch
from lanestream.engine import load_engine
from lanestream.errors import LanestreamError
from lanestream_exporter.datasets.manifest import DatasetCollection
from lanestream_exporter.datasets.splits import Split
from lanestream_exporter.evaluation.outcomes import MOST_CANDIDATES, Proposed, judge

COUNTS = (4, 8, 12, 16, 24, 32)

_ALL = CandidateSearch(limit=MOST_CANDIDATES)
_STRAIGHT = replace(_ALL, perspective=replace(_ALL.perspective, spread_bend=1e-9))


def steps() -> Iterator[tuple[str, CandidateSearch, EgoPriorEstimator | None]]:
    """The steps, each with what those before it have."""
    yield "Hough edges", replace(_STRAIGHT, sources=("singles",)), None
    yield "and their pairs", replace(_STRAIGHT, sources=("singles", "pairs")), None
    yield "and the fan", _STRAIGHT, None
    yield "and bends", _ALL, None
    yield "and the regressor", _ALL, load_engine(provider="cpu").pipeline().glance


@click.command()
@click.option("--split", type=click.Choice(["train", "val", "test"]), default="test", show_default=True)
@click.option("--json", "path", type=click.Path(path_type=Path), default=Path("out/proposals.json"), show_default=True)
def main(split: Split, path: Path) -> None:
    """Print the share of labelled boundaries with a true candidate among the first N, by drive and step."""
    try:
        frames = list(DatasetCollection.open().frames(split))
    except LanestreamError as error:
        raise click.ClickException(str(error)) from error
    told: dict[str, dict[str, dict[str, object]]] = {}
    for name, search, glance in steps():
        detector = CandidateDetector(search=search)
        proposed: dict[str, list[Proposed]] = {}
        for frame, image in frames:
            prior = None if glance is None else answered(glance.look(image))
            prepared = detector.prepare(image, prior=prior)
            nothing = np.zeros((len(prepared.candidates), 2), np.float32)
            proposed.setdefault(frame.group, []).extend(judge(prepared, nothing, prepared, frame).proposed)
        for drive, labels in proposed.items():
            told.setdefault(drive, {})[name] = {"ego": recall(labels, True), "all": recall(labels, False)}
    for drive, rows in told.items():
        click.echo(f"\n{drive}: {_count(rows)} labels, ego and all, with {', '.join(map(str, COUNTS))} candidates")
        for name, row in rows.items():
            click.echo(f"  {name:18} {_shares(row['ego'])}   {_shares(row['all'])}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")


def recall(labels: list[Proposed], ego: bool) -> dict[str, object]:
    """Counts and shares of the labels that the first N candidates hold."""
    places = [label.place for label in labels if label.ego or not ego]
    found = {n: sum(place is not None and place < n for place in places) for n in COUNTS}
    return {"labels": len(places), "found": found, "recall": {n: round(k / len(places), 4) for n, k in found.items()}}


def _shares(figures: object) -> str:
    assert isinstance(figures, Mapping)  # noqa: S101 - made by `recall`
    return " ".join(f"{share:.3f}" for share in figures["recall"].values())


def _count(rows: Mapping[str, Mapping[str, object]]) -> str:
    first = next(iter(rows.values()))
    return " and ".join(str(first[which]["labels"]) for which in ("ego", "all"))  # type: ignore[index]


if __name__ == "__main__":
    main()
