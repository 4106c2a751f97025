"""A complete evaluation of rendered frames: models, baselines, documented figures, the report, the command."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from documentation import table_keys

from lanestream.engine import load_engine
from lanestream.errors import LabelError
from lanestream.road.appearance import BOUNDARY_KINDS
from lanestream.road.curve import Curve
from lanestream.road.view import Image
from lanestream_exporter.datasets.clips import read_clip_labels
from lanestream_exporter.datasets.labels import WHOLE, LabeledFrame
from lanestream_exporter.datasets.manifest import LabeledClip
from lanestream_exporter.evaluation.baselines import HoughLinesBaseline, SlidingWindowBaseline
from lanestream_exporter.evaluation.boundaries import ReportedBoundary, match_ego
from lanestream_exporter.evaluation.gallery import drawn
from lanestream_exporter.evaluation.measuring import OVERALL, Evaluation, EvaluationSet, Extras, run_evaluation
from lanestream_exporter.evaluation.methods import Baseline, ServedModel
from lanestream_exporter.evaluation.outcomes import FrameEvaluation
from lanestream_exporter.evaluation.report import write_report
from lanestream_exporter.evaluation.tables import figure_tables
from lanestream_exporter.evaluation_commands import evaluate as command
from lanestream_exporter.scenes import Drive, render_still, sample_clip, write_clip

DOCUMENT = Path(__file__).parents[4] / "docs" / "evaluation.md"
BASELINES = [HoughLinesBaseline(), SlidingWindowBaseline()]


def still(seed: int, width: int = 640, height: int = 360) -> tuple[LabeledFrame, Image]:
    rng = np.random.default_rng(seed)
    drive = Drive("highway", fair=True)
    rendered = render_still(sample_clip(rng, width, height, frames=1, fps=25.0, drive=drive).scene_at(0))
    return rendered.labels, rendered.image


def straight_road(width: int, height: int) -> Image:
    """Returns two solid white lines on dark asphalt that meet at 45 % of the height."""
    image = np.full((height, width, 3), 60, np.uint8)
    horizon = 0.45 * height
    for b in (-1.0, 1.0):
        for y in range(int(horizon) + 2, height):
            x, half = 0.5 * width + b * (y - horizon), 0.03 * (y - horizon) + 1.0
            image[y, max(0, round(x - half)) : max(0, round(x + half) + 1)] = 235
    return image


@pytest.mark.parametrize("baseline", BASELINES, ids=lambda baseline: type(baseline).__name__)
@pytest.mark.parametrize(("width", "height"), [(640, 360), (1280, 720), (960, 540)])
def test_baselines_find_a_straight_road_at_any_size(baseline: Any, width: int, height: int) -> None:
    found = {boundary.position: boundary for boundary in baseline.detect(straight_road(width, height))}
    assert set(found) == {-1, 1}
    for side, boundary in found.items():
        rows = np.linspace(boundary.top + 0.02 * height, 0.9 * height, 8)
        expected = 0.5 * width + side * (rows - 0.45 * height)
        np.testing.assert_allclose(boundary.curve.x(rows), expected, atol=0.012 * width)


@pytest.mark.parametrize("baseline", BASELINES, ids=lambda baseline: type(baseline).__name__)
@pytest.mark.parametrize("level", [0, 128, 255])
def test_baselines_find_nothing_in_a_uniform_image(baseline: Any, level: int) -> None:
    assert baseline.detect(np.full((360, 640, 3), level, np.uint8)) == ()


@pytest.mark.parametrize("baseline", BASELINES, ids=lambda baseline: type(baseline).__name__)
def test_baselines_find_boundaries_on_some_rendered_highways(baseline: Any) -> None:
    right = sum(len(match_ego(baseline.detect(image), frame).matches) for frame, image in map(still, range(24, 34)))
    assert right >= 4


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> LabeledClip:
    folder = tmp_path_factory.mktemp("clip")
    rng = np.random.default_rng(24)
    made = sample_clip(rng, 320, 180, frames=8, fps=25.0, drive=Drive("highway", fair=True))
    video, labels = folder / "road.mp4", folder / "road.jsonl"
    write_clip(made, video, labels)
    return LabeledClip("road", video, read_clip_labels(labels, WHOLE), range(1000))


@pytest.fixture(scope="module")
def evaluation(clip: LabeledClip) -> Evaluation:
    frames = [
        (replace(labels, dataset=f"set {seed % 2}", conditions={"light": "day"}), image)
        for seed in range(24, 28)
        for labels, image in [still(seed)]
    ]
    methods = [ServedModel(load_engine(provider="cpu")), *map(Baseline, BASELINES)]
    return run_evaluation(methods, EvaluationSet("rendered", lambda: iter(frames), (clip,)), extras=Extras(4, 4, 6))


@pytest.fixture(scope="module")
def figures(evaluation: Evaluation) -> dict[str, Any]:
    return evaluation.figures()


def test_all_methods_process_the_same_frames(evaluation: Evaluation, figures: dict[str, Any]) -> None:
    kinds = [method["kind"] for method in figures["methods"].values()]
    regressors = [method["regressor"] for method in figures["methods"].values()]
    assert regressors[0].startswith("lanestream-regressor")
    assert regressors[1:] == [None, None]
    assert kinds == ["classifier", "baseline", "baseline"]
    for name, kind in zip(figures["methods"], kinds, strict=True):
        part = figures["images"][name][OVERALL]
        assert part["boundaries"]["ego"]["frames"] == part["field"]["tusimple"]["frames"] == 4
        assert ("candidates" in part) == (kind == "classifier")
        assert figures["clips"][name]["road"]["steadiness"]["frames"] == 8
        tracked = figures["clips"][name]["road"]["tracked"]["ego"]
        assert tracked["frames"] == figures["clips"][name]["road"]["alone"]["ego"]["frames"] == 8
        assert tracked["right"] + tracked["missed"] == 16
        same_without_tracker = figures["clips"][name]["road"]["alone"]["ego"]["right"] == tracked["right"]
        assert same_without_tracker or kind != "baseline"


def test_the_same_frames_give_the_same_figures(evaluation: Evaluation, figures: dict[str, Any]) -> None:
    assert json.dumps(evaluation.figures()) == json.dumps(figures)
    assert "NaN" not in json.dumps(figures)


def documented() -> set[str]:
    """Returns the keys of the tables, each below every base that the paragraph before its table names."""
    text = DOCUMENT.read_text(encoding="utf-8")
    keys: set[str] = set()
    bases = [""]
    for part in text[text.index("## The keys of the JSON file") :].split("\n\n"):
        if part.startswith("|"):
            keys.update(key for base in bases for key in table_keys(part, base))
        else:
            bases = re.findall(r"`((?:images|datasets|conditions|clips|no_road|towns|stills)\.[^`]*)`", part) or [""]
    return keys


def written(value: Any, path: str = "") -> Iterator[str]:
    if isinstance(value, dict):
        names = dict.fromkeys(
            ("methods", "images", "datasets", "conditions", "clips", "no_road", "towns", "stills"), "<method>"
        )
        names |= {"images.<method>": "<drive>", "clips.<method>": "<clip>"}
        names |= {"datasets.<method>": "<dataset>", "conditions.<method>": "<condition>"}
        names |= {"no_road.<method>": "<picture>", "stills.<method>": "<source>"}
        for key, part in value.items():
            yield from written(part, f"{path}.{names.get(path, key)}".lstrip("."))
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for part in value:
            yield from written(part, f"{path}[]")
    else:
        yield path


def test_the_documented_keys_are_the_written_keys(figures: dict[str, Any]) -> None:
    assert sorted(documented()) == sorted(set(written(figures)))


def test_the_report_is_self_contained(evaluation: Evaluation, figures: dict[str, Any], tmp_path: Path) -> None:
    page = write_report(tmp_path / "new" / "folder", evaluation, figures).read_text(encoding="utf-8")
    assert page.count("<svg") == page.count("</svg>") == 7
    assert page.count("data:image/jpeg;base64,") == 4
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page)
    assert not re.findall(r"<script|@import", page)
    for method in figures["methods"]:
        assert method.replace("'", "&#39;") in page
    identifiers = re.findall(r'\bid="([^"]+)"', page)
    assert len(identifiers) == len(set(identifiers))
    assert "None" not in re.sub(r"<svg.*?</svg>", "", page, flags=re.DOTALL)


def test_the_worst_frames_come_first(evaluation: Evaluation, figures: dict[str, Any], tmp_path: Path) -> None:
    page = write_report(tmp_path, evaluation, figures).read_text(encoding="utf-8")
    mistakes = [
        int(a) + int(b) for a, b in re.findall(r"<figcaption>[^<]*ego \d+ right, (\d+) wrong, (\d+) missed", page)
    ]
    assert len(mistakes) == 4
    assert mistakes == sorted(mistakes, reverse=True)


def test_the_tables_name_every_method_and_drive(figures: dict[str, Any]) -> None:
    made = list(figure_tables(figures))
    drives = len(figures["images"][BASELINES[0].name])
    assert drives == 5
    sets, conditions, clips = 2, 1, 2
    kinds = [4 * sets] * 2 + [4 * conditions] * 2 + [4 * drives, 4 * clips]
    assert [table.row_count for table in made] == [
        *kinds, 4, 4, 8, 7, 7, 2 * drives, 2 * drives, 4 * drives, 4 * clips, 4 * clips, *[4 * drives] * 3
    ]  # fmt: skip


def test_data_sets_and_conditions_share_the_frames_among_them(figures: dict[str, Any]) -> None:
    name = BASELINES[0].name
    sets, conditions = figures["datasets"][name], figures["conditions"][name]
    assert {part: groups["boundaries"]["ego"]["frames"] for part, groups in sets.items()} == {"set 0": 2, "set 1": 2}
    whole = figures["images"][name][OVERALL]
    assert conditions == {"light: day": {"boundaries": whole["boundaries"], "kinds": whole["kinds"]}}


def test_the_report_begins_with_the_verdicts(evaluation: Evaluation, figures: dict[str, Any], tmp_path: Path) -> None:
    page = write_report(tmp_path, evaluation, figures).read_text(encoding="utf-8")
    first = page.index("<table>")
    ego = figures["images"][evaluation.methods[0].name][OVERALL]["boundaries"]["ego"]
    line = f"ego boundaries: {ego['right']} of {ego['right'] + ego['missed']} right, {ego['wrong']} wrong"
    assert line in figures["verdicts"][0]
    for verdict in figures["verdicts"]:
        assert 0 < page.index(verdict.replace("'", "&#39;")) < first


def test_the_gallery_shows_markings_as_lines_and_edges_as_dots() -> None:
    labels, image = still(24)
    curve = Curve(160.0, (320.0, 0.0, 0.0))
    columns = {}
    for kind in BOUNDARY_KINDS:
        report = ReportedBoundary(curve, 200.0, 350.0, -1, kind=kind)
        outcome = FrameEvaluation(replace(labels, lanes=()), (report,))
        picture = drawn(np.zeros_like(image), outcome)
        assert picture.shape[1] >= 640
        columns[kind] = picture[:, 480].any(axis=1)[310:510]
    assert columns["marking"].all()
    assert 0.2 < columns["road_edge"].mean() < 0.8


def test_a_dataset_without_labels_is_an_error() -> None:
    with pytest.raises(LabelError, match="empty has no labeled frames"):
        run_evaluation([Baseline(HoughLinesBaseline())], EvaluationSet("empty", lambda: iter(())))


def test_the_command_evaluates_own_frames(tmp_path: Path) -> None:
    rows = list(range(300, 711, 10))
    cv2.imwrite(str(tmp_path / "road.png"), straight_road(1280, 720))
    lanes = [[int(640 + side * (row - 324)) if row > 340 else -2 for row in rows] for side in (-1, 1)]
    record = {"raw_file": "road.png", "h_samples": rows, "lanes": lanes}
    (tmp_path / "labels.json").write_text(json.dumps(record) + "\n")
    path = tmp_path / "made" / "figures.json"
    arguments = ["--data", str(tmp_path), "--format", "tusimple", "--json", str(path), "--out", str(tmp_path / "made")]
    arguments += ["--labels-only"]
    result = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    figures = json.loads(path.read_text())
    assert figures["clips"] == {name: {} for name in figures["methods"]}
    for name in ("no_road", "towns", "stills"):
        assert not any(figures[name].values())
    baseline = figures["images"][BASELINES[0].name][OVERALL]
    assert (baseline["boundaries"]["ego"]["right"], baseline["boundaries"]["ego"]["missed"]) == (2, 0)
    assert (tmp_path / "made" / "report.html").is_file()
