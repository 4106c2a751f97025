"""Fits how often the candidate detector's decisions are right: the numbers in lanestream/detection/acceptance.py.

Rendered towns, rendered scenes of all kinds and every third training frame go through the shipped networks as single
images, with an acceptance that changes no probability. Neither validation nor test frames are used.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import click
import numpy as np
from sklearn.linear_model import LogisticRegression

from lanestream.detection.acceptance import Acceptance, is_certain_lane
from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.engine import load_engine
from lanestream.errors import LanestreamError
from lanestream.road.view import Image
from lanestream_exporter.datasets.labels import LabeledFrame
from lanestream_exporter.datasets.manifest import DatasetCollection
from lanestream_exporter.evaluation.methods import ServedModel
from lanestream_exporter.evaluation.outcomes import FrameEvaluation
from lanestream_exporter.evaluation.reliability import Role, judged_reports
from lanestream_exporter.evaluation.towns import TOWN_STYLES
from lanestream_exporter.scenes import render_still, sample_scene
from lanestream_exporter.scenes.scene import STYLES

_SIZES = ((1280, 720), (640, 480), (960, 540))
_TOWNS, _SCENES, _EVERY = 500, 400, 3
# Differs from the last part of the seeds of training scenes and of evaluations.
_SEED = 7


def frames(data: Path | None) -> Iterator[tuple[LabeledFrame, Image]]:
    """Yields the labels and the image of each frame. Raises LabelError at once if there are no real frames."""
    yield from islice(DatasetCollection.open(None, data).frames("train"), 0, None, _EVERY)
    for index in range(_TOWNS + _SCENES):
        rng = np.random.default_rng([0, index, _SEED])
        still = render_still(sample_scene(rng, *_SIZES[index % 3], TOWN_STYLES if index < _TOWNS else STYLES))
        yield still.labels, still.image


@click.command()
@click.option("--data", type=click.Path(path_type=Path), help="Folder of real frames.  [default: $LANESTREAM_DATA]")
def main(data: Path | None) -> None:
    """Print the slope and the offset for boundaries of the ego lane, outer ones, and those beside a certain lane."""
    engine = load_engine(provider="cpu")
    name = engine.select()
    detector = engine.detectors[name]
    if not isinstance(detector, CandidateDetector):
        raise click.ClickException("the shipped engine has no candidate detector")
    neutral = {**engine.detectors, name: replace(detector, acceptance=Acceptance())}
    method = ServedModel(replace(engine, detectors=neutral))
    try:
        outcomes = [FrameEvaluation(frame, method.find(image)) for frame, image in frames(data)]
    except LanestreamError as error:
        raise click.ClickException(str(error)) from error
    certain = [outcome for outcome in outcomes if _has_certain_lane(outcome)]
    others = [outcome for outcome in outcomes if not _has_certain_lane(outcome)]
    groups: tuple[tuple[str, Role, list[FrameEvaluation]], ...] = (
        ("ego", "ego", outcomes),
        ("outer", "outer", others),
        ("beside_lane", "outer", certain),
    )
    for title, role, part in groups:
        judged = [judged_reports(outcome, role) for outcome in part]
        is_right = np.concatenate([right for right, _ in judged])
        decided = np.clip(np.concatenate([values for _, values in judged]), 1e-3, 1.0 - 1e-3)
        model = LogisticRegression(C=1e4).fit(np.log(decided / (1.0 - decided))[:, None], is_right)
        click.echo(
            f"{title}: slope {model.coef_[0, 0]:.2f}, offset {model.intercept_[0]:.2f}, from {len(decided)} reports, "
            f"{int(is_right.sum())} of them right"
        )


def _has_certain_lane(outcome: FrameEvaluation) -> bool:
    ego = [report for report in outcome.reports if abs(report.position) == 1]
    return is_certain_lane([(report.kind, report.probability or 0.0) for report in ego])


if __name__ == "__main__":
    main()
