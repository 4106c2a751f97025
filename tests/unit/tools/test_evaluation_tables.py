"""`tools/evaluation_tables.py` on a small evaluation of a baseline."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from evaluation_tables import main

from lanestream.engine import load_engine
from lanestream_exporter.datasets.labels import Coverage, LabeledFrame, LabeledLane
from lanestream_exporter.evaluation.baselines import HoughLinesBaseline
from lanestream_exporter.evaluation.measuring import EvaluationSet, Extras, run_evaluation
from lanestream_exporter.evaluation.methods import Baseline, ServedModel
from lanestream_exporter.evaluation.reliability import LEAST
from lanestream_exporter.evaluation.towns import town_frames


def test_the_tables_have_a_row_for_each_part_with_such_figures(tmp_path: Path) -> None:
    kerb = LabeledLane(np.array([[100.0, 350.0], [300.0, 180.0]]), type="kerb")
    unmarked = Coverage(edges=True, markings=False)
    frames = [
        LabeledFrame(640, 360, (kerb,), "park", "a.png", unmarked, "campus", conditions={"light": "dusk"}),
        LabeledFrame(640, 360, (LabeledLane(kerb.points),), "road", "b.png", dataset="highway"),
    ]
    image = np.full((360, 640, 3), 90, np.uint8)
    evaluation = run_evaluation(
        [Baseline(HoughLinesBaseline())], EvaluationSet("made", lambda: iter([(frame, image) for frame in frames]))
    )
    path = tmp_path / "evaluation.json"
    path.write_text(json.dumps(evaluation.figures()))
    result = CliRunner().invoke(main, [str(path)], catch_exceptions=False)
    name = HoughLinesBaseline().name
    tables = dict(part.split("**\n", 1) for part in result.output.split("\n**")[1:])
    assert f"- {name}: ego boundaries: 0 of 2 right, 0 wrong" in result.output
    assert f"| highway, {name} | 1.000 | - (0 / 0) |" in tables["Boundaries by data set"]
    assert f"| light: dusk, {name} |" in tables["Boundaries by condition"]
    # The labels of the highway say nothing of kinds.
    assert [row.split(",")[0] for row in tables["Kinds by data set"].splitlines()[3:] if row] == ["| campus"]
    assert f"| campus, {name} | 0.000 (0 / 1) | - (0 / 0) | 0.000 (0 / 1) |" in tables["Kinds by data set"]


def test_reliability_has_a_row_for_each_probability(tmp_path: Path) -> None:
    labels, image = next(town_frames(1))
    evaluation = run_evaluation(
        [ServedModel(load_engine(provider="cpu"))],
        EvaluationSet("made", lambda: iter([(labels, image)])),
        extras=Extras(towns=4),
    )
    path = tmp_path / "evaluation.json"
    path.write_text(json.dumps(evaluation.figures()))
    result = CliRunner().invoke(main, [str(path)], catch_exceptions=False)
    tables = dict(part.split("**\n", 1) for part in result.output.split("\n**")[1:])
    for name in ("Reliability, single images", "Reliability, rendered towns"):
        rows = tables[name].splitlines()[3:]
        assert [row.split(",")[1].split("|")[0].strip() for row in rows if row] == [f"from {least}" for least in LEAST]
    assert tables["Rendered towns"].count("| rendered towns, ") == 1


def test_another_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text("{}")
    result = CliRunner().invoke(main, [str(tmp_path / "other.json")])
    assert result.exit_code == 1
    assert "was not written by `lanestream evaluate --json`" in result.output
