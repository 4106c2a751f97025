"""`lanestream evaluate tracking` on a short rendered clip and a short labeled video: two systems, figures, plots."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from click.testing import CliRunner
from documentation import table_keys

from lanestream.engine import SHIPPED_MODEL
from lanestream.errors import SourceError
from lanestream.road.view import Image
from lanestream_exporter.datasets.manifest import DatasetCollection
from lanestream_exporter.evaluation.tracking import rendered
from lanestream_exporter.evaluation.tracking.figures import rendered_figures
from lanestream_exporter.evaluation.tracking.real import real_clips
from lanestream_exporter.evaluation.tracking.rendered import RenderedSet, run_rendered
from lanestream_exporter.evaluation.tracking.systems import CheckoutSystem, PresentSystem, SystemSpec
from lanestream_exporter.evaluation_commands import evaluate as command
from lanestream_exporter.scenes import Drive, sample_clip, write_clip
from lanestream_exporter.scenes.tracking_clips import KINDS, sample_tracking_clip

ROOT = Path(__file__).parents[5]
DOCUMENT = ROOT / "docs" / "evaluation.md"
FRAMES = 12

Frames = Iterator[tuple[Image, dict[str, Any]]]


class ShortClip:
    """The first frames of a rendered clip."""

    def __init__(self, kind: str, seed: int) -> None:
        self._clip = sample_tracking_clip(kind, seed)

    def frames(self) -> Frames:
        return islice(self._clip.frames(), FRAMES)


@pytest.fixture(autouse=True, scope="module")
def _short_clips() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendered, "sample_tracking_clip", ShortClip)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a folder with the manifest of one short labeled video, whose last four frames are held out."""
    folder = tmp_path_factory.mktemp("real")
    made = sample_clip(np.random.default_rng(24), 320, 180, frames=12, fps=25.0, drive=Drive("highway", fair=True))
    write_clip(made, folder / "road.mp4", folder / "road.jsonl")
    (folder / "datasets.toml").write_text(
        '[[dataset]]\nname = "road"\npath = "road.jsonl"\nformat = "clips"\n'
        'split = { by = "frame", train = [0, 6], val = [6, 8], test = [8, 12] }\n'
    )
    return folder


@pytest.fixture(scope="module")
def printed(folder: Path) -> str:
    """Runs the command with this checkout as the other one, and returns what it prints."""
    result = CliRunner().invoke(
        command,
        [
            "tracking", "--rendered", "1", "--seeds", "3", "--kind", "keeping",
            "--real", "--manifest", str(folder / "datasets.toml"),
            "--model", str(SHIPPED_MODEL), "--against", str(ROOT),
            "-o", str(folder / "new" / "tracking.json"), "--plots", str(folder / "plots"),
        ],
        catch_exceptions=False,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def figures(folder: Path, printed: str) -> dict[str, Any]:
    made: dict[str, Any] = json.loads((folder / "new" / "tracking.json").read_text())
    return made


def test_two_checkouts_get_the_same_frames(figures: dict[str, Any]) -> None:
    """The other checkout is this one, so both have the same figures."""
    assert figures["seeds"] == [3, 4]
    assert figures["systems"]["against"]["checkout"] == str(ROOT)
    present, against = (dict(figures["rendered"][name]["keeping"]) for name in ("present", "against"))
    for part in (present, against):
        part["uncertainty"] = {**part["uncertainty"], "nis": None}  # not on the wire
    assert present == against
    assert present["frames"] == figures["rendered"]["present"]["overall"]["frames"] == FRAMES
    assert present["errors"]["followed"]["followed"] > 0


def test_tables_and_plots_show_both(folder: Path, printed: str) -> None:
    assert "Identity and lane changes" in printed
    assert "Labeled real clips" in printed
    assert printed.count(" against") == printed.count(" present")
    assert {path.name for path in (folder / "plots").iterdir()} == {"coverage.png", "gaps.png", "bottom-keeping.png"}


def test_real_clips_are_tracked_and_their_detections_compared(figures: dict[str, Any]) -> None:
    clip = figures["real"]["present"]["road"]
    assert (clip["frames"], clip["labeled_frames"], clip["both_ego"]["frames"]) == (8, 8, 8)
    assert clip["both_ego_second_half"]["frames"] == 4
    assert clip["errors"]["paired"]["boundaries"] > 0
    assert clip["errors"]["detections"]["boundaries"] > 0
    assert clip["uncertainty"]["all"]["coverage"]["bottom"]["values"] > 0
    # Another checkout does not show its detections.
    assert figures["real"]["against"]["road"]["errors"]["detections"]["boundaries"] == 0


def test_held_out_frames_are_a_clip_of_their_own(folder: Path) -> None:
    datasets = DatasetCollection.open(folder / "datasets.toml")
    assert [(clip.name, clip.frames) for clip in real_clips(datasets, held_out=False)] == [("road", range(8))]
    clips = real_clips(datasets, held_out=True)
    assert [(clip.name, clip.frames) for clip in clips] == [("road", range(8)), ("road held out", range(8, 12))]
    assert sorted(clips[0].labeled) == list(range(8))


def test_jobs_do_not_change_the_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendered, "ProcessPoolExecutor", InThisProcess)
    clips = RenderedSet(("keeping",), range(3))
    one, two = (run_rendered([SystemSpec("present")], clips, jobs)["present"] for jobs in (1, 2))
    assert [(run.kind, run.name) for run in one] == [(run.kind, run.name) for run in two]
    assert rendered_figures(one) == rendered_figures(two)


class InThisProcess:
    """An executor that runs its tasks at once."""

    def __init__(self, *_: Any, **__: Any) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...

    def submit(self, function: Any, *arguments: Any) -> Any:
        value = function(*arguments)
        return type("Done", (), {"result": lambda _: value})()


def test_a_checkout_answers_like_this_process_and_keeps_its_streams_apart() -> None:
    frames = list(ShortClip("keeping", 3).frames())[:3]
    present, checkout = PresentSystem(), CheckoutSystem(ROOT)
    try:
        for system in (present, checkout):
            assert system.description["version"]
        answers = {}
        for name, system in (("present", present), ("checkout", checkout)):
            stream, alone = system.open(frames[0][1]["camera"]), system.open(None, single_image=True)
            seen = [stream(image, record["timestamp"])() for image, record in frames]
            again = alone(frames[0][0], 0.0)()
            seen.append(stream(frames[2][0], 0.12)())
            # Only this process sees the innovations.
            seen = [{key: value for key, value in answer.items() if key != "nis"} for answer in seen]
            answers[name] = [{**answer, "seq": 0} for answer in seen], again["lanes"]
        assert answers["present"] == answers["checkout"]
    finally:
        checkout.close()


def test_a_folder_without_this_project_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="has no service/lanestream"):
        CheckoutSystem(tmp_path)


def test_a_checkout_that_fails_is_an_error(tmp_path: Path) -> None:
    package = tmp_path / "service" / "lanestream"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    with pytest.raises(SourceError, match="ended with exit code 1"):
        CheckoutSystem(tmp_path)


def test_unknown_kinds_and_misplaced_options_are_refused() -> None:
    unknown = CliRunner().invoke(command, ["tracking", "--kind", "flying"])
    assert unknown.exit_code == 2
    assert "'flying' is not one of 'keeping'" in unknown.output
    misplaced = CliRunner().invoke(command, ["--split", "val", "tracking"])
    assert misplaced.exit_code == 2
    assert "--split is an option of `evaluate`" in misplaced.output


# The documented keys


def documented() -> set[str]:
    text = DOCUMENT.read_text(encoding="utf-8")
    section = text[text.index("### The keys of tracking") : text.index("## The keys of the JSON file")]
    keys: set[str] = set()
    base = ""
    for part in section.split("\n\n"):
        if part.startswith("|"):
            keys.update(table_keys(part, base))
        else:
            base = next(iter(re.findall(r"`((?:rendered|real)\.[^`]*)`", part)), "")
    return keys


def written(value: Any, path: str = "") -> Iterator[str]:
    names = {"systems": "<system>", "rendered": "<system>", "real": "<system>"}
    names |= {"rendered.<system>": "<kind>", "real.<system>": "<clip>", "rendered.<system>.<kind>.gaps": "<frames>"}
    if not isinstance(value, dict):
        yield path
        return
    for key, part in value.items():
        yield from written(part, f"{path}.{names.get(path, key)}".lstrip("."))


def test_the_documented_keys_are_the_written_keys(figures: dict[str, Any]) -> None:
    assert sorted(documented()) == sorted(set(written(figures)))


def test_every_kind_is_documented() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    section = text[text.index("## Tracking") : text.index("### The keys of tracking")]
    assert all(f"`{kind}`" in section for kind in KINDS)
