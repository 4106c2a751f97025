"""What each stage of the candidate detector is worth: every stage left out once, with everything else as served.

Material: the labelled training and validation frames as single images, the clips of those splits as streams, rendered
scenes as single images and rendered drives as streams, from seeds that no training run uses. Nothing here touches the
test split. Each stage runs on the same frames, so differences are paired: the interval of a difference is a bootstrap
over images and drives.
"""

from __future__ import annotations

import json
import pickle
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import click
import cv2
import numpy as np

from lanestream.detection import candidates as search
from lanestream.detection import detector as decision
from lanestream.detection.bars import BarSearch
from lanestream.detection.candidates import CandidateSearch
from lanestream.detection.commonroad import CommonRoad
from lanestream.detection.doubles import DoubleLines
from lanestream.detection.lattice import Lattice
from lanestream.detection.lines import Lines
from lanestream.detection.perspective import PerspectiveSearch
from lanestream.detection.prior import RoadGlance, RoadPrior
from lanestream.detection.refinement import Fit, Refinement
from lanestream.detection.regression import RegressionDetector
from lanestream.engine import Engine, load_engine
from lanestream.processors import processors
from lanestream.runtime import RuntimeOptions
from lanestream_exporter.datasets.clips import read_clip_labels
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.datasets.splits import data_root, labelled_clips, real_frames
from lanestream_exporter.evaluation.boundaries import Found, Verdict, match, match_ego
from lanestream_exporter.scenes import render_still, sample_scene
from lanestream_exporter.scenes.clip import render_clip, sample_clip

SCENES, DRIVES, DRIVE_FRAMES, FPS = 480, 48, 50, 20.0
# Training seeds begin with the number of a file: below ten thousand.
SEED = 31_415_926
SIZES = ((640, 360), (640, 480), (960, 540), (1280, 720))
# Of the country road's 2,000 training frames this many are followed; single images are all of its labels.
COUNTRY_FRAMES = 800

Apply = Callable[[Engine, ExitStack], Engine]


@dataclass(frozen=True)
class Part:
    """An image or a drive: encoded frames, their times, and labels by the number of the frame."""

    group: str
    frames: tuple[bytes, ...]
    fps: float
    labels: dict[int, LabelledFrame]


def _search(engine: Engine, **changes: Any) -> Engine:
    return _detector(engine, search=replace(engine.detector.search, **changes))


def _detector(engine: Engine, **changes: Any) -> Engine:
    first, *rest = engine.pipelines
    return Engine([replace(first, detector=replace(first.detector, **changes)), *rest])


def _refinement(engine: Engine, **changes: Any) -> Engine:
    return _detector(engine, refinement=replace(engine.detector.refinement, **changes))


def _patched(target: Any, name: str, new: Any) -> Apply:
    def apply(engine: Engine, stack: ExitStack) -> Engine:
        stack.enter_context(patch.object(target, name, new))
        return engine

    return apply


def _no_prior(engine: Engine, _: ExitStack) -> Engine:
    first, *rest = engine.pipelines
    return Engine([replace(first, glance=None), *rest])


def _straight_look(engine: Engine, stack: ExitStack) -> Engine:
    prepare, read = RegressionDetector.prepare, RegressionDetector.read

    def once(self: Any, *args: Any, **kwargs: Any) -> Any:
        prepared = prepare(self, *args, **kwargs)
        straight = prepared.inputs[: len(prepared.looks)]
        return replace(prepared, parts=(lambda: straight,))

    def read_once(self: Any, prepared: Any, outputs: Any) -> Any:
        from lanestream.detection.regression import RoadReading

        readings = [RoadReading.of(one) for one in outputs]
        best = min(range(len(readings)), key=lambda i: readings[i].doubt)
        return readings[best], readings[best].view(prepared.looks[best])

    stack.enter_context(patch.object(RegressionDetector, "prepare", once))
    stack.enter_context(patch.object(RegressionDetector, "read", read_once))
    del read
    return engine


def _no_paint(engine: Engine, stack: ExitStack) -> Engine:
    stack.enter_context(patch.object(RegressionDetector, "fitted", lambda _s, _i, _r, view, _n=(): ({}, view)))
    return engine


def _no_kept(guides: bool = True, neighbours: bool = True, twins: bool = True, known: bool = True) -> Apply:
    kept = CandidateSearch._kept

    def without(self: Any, known_: Lines, led: Any, painted: Lines, found: Lines, view: Any) -> Lines:
        none = Lines.joined([])
        led = [led[0] if guides else none, led[1] if neighbours else none]
        if not twins:
            self = replace(self, twin=self.separation)
        return kept(self, known_ if known else none, led, painted, found, view)

    return _patched(CandidateSearch, "_kept", without)


def _best_candidate(self: Any, candidates: Any, _p: Any, _a: Any, chosen: Any, _v: Any) -> Any:
    return [candidates[i] for i in chosen]


def _no_fit(self: Any, image: Any, candidates: Any, view: Any, doubts: Any = None) -> Any:
    del image, doubts
    return [Fit(c.curve, np.diag([4.0, 4e-4, 4e4])) for c in candidates], view


def _hough_off(self: Any, grey: Any, top: float) -> Any:
    del self, grey, top
    nothing = np.empty(0)
    from lanestream.detection.hough import HoughLines

    return HoughLines(nothing, nothing, nothing > 0.0, nothing)


STAGES: dict[str, Apply | None] = {
    "everything": None,
    "regressor's prior": _no_prior,
    "second look of the regressor": _patched(__import__("lanestream.detection.prior", fromlist=["x"]), "_SECOND_LOOK", 9.0),
    "mirrored look of the regressor": _straight_look,
    "prior's boundaries as candidates": _no_kept(guides=False),
    "prior's boundaries on the paint": _no_paint,
    "prior's neighbouring boundaries": _no_kept(neighbours=False),
    "lines beside the prior's boundaries": _no_kept(twins=False),
    "tracked boundaries as candidates": _no_kept(known=False),
    "lane-spacing weight of lines": _patched(Lattice, "trust", lambda self, slopes: np.ones(len(slopes))),
    "search without the prior (first frames)": _patched(CandidateSearch, "_unguided", lambda *_: Lines.joined([])),
    "Hough pairs": lambda e, _: _search(e, sources=("singles", "rays")),
    "Hough single edges": lambda e, _: _search(e, sources=("pairs", "rays")),
    "Hough pairs and single edges": lambda e, _: _search(e, sources=("rays",)),
    "Hough transform": lambda e, s: _search(_patched(CandidateSearch, "_edges_and_lines", _hough_off)(e, s), sources=("rays",)),
    "vanishing-point line search": lambda e, _: _search(e, sources=("pairs", "singles")),
    "curvature in the perspective search": lambda e, _: _search(
        e,
        perspective=replace(e.detector.search.perspective, spread_bend=1e-9),
        near_prior=replace(e.detector.search.near_prior, spread_bend=1e-9),
    ),
    "perspective search": _patched(PerspectiveSearch, "refine", lambda self, guess, *_, **__: guess),
    "least strength of a line": lambda e, _: _search(e, faintest=0.0),
    "prior's odds": _patched(RoadPrior, "odds", lambda self, curves: np.ones(len(curves))),
    "mean of candidates that agree": _patched(decision.CandidateDetector, "_together", _best_candidate),
    "curve fit": _patched(Refinement, "refine", _no_fit),
    "common road in the fit": lambda e, _: _refinement(e, road=CommonRoad(vanishing=9.0, bend=9.0)),
    "common horizon in the fit": lambda e, _: _refinement(e, road=CommonRoad(usual=(0.1, 1e-6, 0.03), nod=1e-6)),
    "double lines": _patched(DoubleLines, "middle", lambda self, bars: 0.0),
    "four rounds of the fit (one)": lambda e, _: _refinement(e, steps=(0.045,)),
    "three widths of the marking filter (one)": lambda e, _: _refinement(e, bars=BarSearch(widths=(0.1,))),
    "half the fit's rows": lambda e, _: _refinement(e, bars=BarSearch(rows=24)),
    "16 candidates (8)": lambda e, _: _search(e, limit=8, followed=8),
    "separation of boundaries": lambda e, _: _detector(e, separation=0.0),
    "half of the ridges' rows": lambda e, _: _search(e, ridges=replace(e.detector.search.ridges, rows=36)),
}
STAGES["fit's horizon and spacing odds"] = None
del STAGES["fit's horizon and spacing odds"]


def material(folder: Path) -> list[Path]:
    """Files of parts, made where they are missing."""
    folder.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(processors(), mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(_scenes, folder, n) for n in range(0, SCENES, 40)]
        jobs += [pool.submit(_drive, folder, n) for n in range(DRIVES)]
        jobs += [pool.submit(_real, folder)]
        return [path for job in jobs for path in job.result()]


def _write(path: Path, make: Callable[[], list[Part]]) -> list[Path]:
    if not path.exists():
        cv2.setNumThreads(1)
        scratch = path.with_suffix(".part")
        scratch.write_bytes(pickle.dumps(make()))
        scratch.rename(path)
    return [path]


def _jpeg(image: Any) -> bytes:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def _scenes(folder: Path, start: int) -> list[Path]:
    def make() -> list[Part]:
        parts = []
        for n in range(start, start + 40):
            still = render_still(sample_scene(np.random.default_rng([SEED, 0, n]), *SIZES[n % len(SIZES)]))
            parts.append(Part("rendered scenes", (_jpeg(still.image),), 1.0, {0: still.labels}))
        return parts

    return _write(folder / f"scenes-{start:04d}.pickle", make)


def _drive(folder: Path, number: int) -> list[Path]:
    def make() -> list[Part]:
        clip = sample_clip(np.random.default_rng([SEED, 1, number]), *SIZES[number % 4], DRIVE_FRAMES, FPS)
        frames = list(render_clip(clip))
        labels = {i: frame.labels for i, frame in enumerate(frames)}
        return [Part("rendered drives", tuple(_jpeg(frame.image) for frame in frames), FPS, labels)]

    return _write(folder / f"drive-{number:04d}.pickle", make)


def _real(folder: Path) -> list[Path]:
    def make() -> list[Part]:
        root = data_root()
        parts = []
        for split in ("train", "val"):
            for frame, image in real_frames(root, split):
                parts.append(Part(f"{frame.group} images", (_jpeg(image),), 1.0, {0: frame}))
            for clip in labelled_clips(root, split):
                labelled = read_clip_labels(clip.labels, clip.coverage)
                if clip.name == "country_road":
                    wanted = range(COUNTRY_FRAMES) if split == "train" else clip.frames
                else:
                    wanted = clip.frames
                video = cv2.VideoCapture(str(clip.video))
                fps = video.get(cv2.CAP_PROP_FPS)
                video.set(cv2.CAP_PROP_POS_FRAMES, wanted.start)
                frames = []
                while len(frames) < len(wanted):
                    ok, image = video.read()
                    if not ok:
                        break
                    frames.append(_jpeg(image))
                labels = {i - wanted.start: f for i, f in labelled.items() if i in wanted}
                parts.append(Part(f"{clip.name} stream", tuple(frames), fps, labels))
        return parts

    return _write(folder / "real.pickle", make)


def _counts(verdict: Verdict) -> list[float]:
    return [len(verdict.pairs), verdict.wrong, verdict.missed, sum(pair.error for pair in verdict.pairs)]


def run_stage(name: str, paths: list[Path]) -> dict[str, Any]:
    """Counts of every part without the stage `name`: ego right, wrong, missed, error; the same of all boundaries."""
    cv2.setNumThreads(1)
    engine = load_engine(provider="cpu", options=RuntimeOptions(threads=1))
    groups, counts, spent, number = [], [], 0.0, 0
    with ExitStack() as stack:
        apply = STAGES[name]
        engine = engine if apply is None else apply(engine, stack)
        for path in paths:
            for part in pickle.loads(path.read_bytes()):
                session = engine.open_session()
                total = np.zeros(8)
                for i, data in enumerate(part.frames):
                    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
                    started = time.process_time()
                    result = engine.process(session, image, i / part.fps)
                    spent += time.process_time() - started
                    number += 1
                    label = part.labels.get(i)
                    if label is not None:
                        found = tuple(Found.of(lane) for lane in result.lanes)
                        total += _counts(match_ego(found, label)) + _counts(match(found, label.lanes, label))
                groups.append(part.group)
                counts.append(total.tolist())
    return {"groups": groups, "counts": counts, "cpu_ms": 1e3 * spent / number}


def f1(counts: Any) -> Any:
    """F1 (...) of counts (..., 4): right, wrong, missed, error."""
    right, wrong, missed = counts[..., 0], counts[..., 1], counts[..., 2]
    return 2.0 * right / np.maximum(2.0 * right + wrong + missed, 1.0)


def loss(base: Any, other: Any, weights: Any) -> tuple[float, float, float]:
    """Points of F1 lost by `other` (N, 4) against `base` (N, 4), and the 95 % interval by resampling parts."""
    points = 100.0 * (f1(base.sum(axis=0)) - f1(other.sum(axis=0)))
    resampled = 100.0 * (f1(weights @ base) - f1(weights @ other))
    low, high = np.percentile(resampled, [2.5, 97.5])
    return float(points), float(low), float(high)


def table(results: dict[str, dict[str, Any]], wanted: Callable[[str], bool]) -> Iterator[str]:
    """A Markdown table of all stages over the groups that are `wanted`."""
    base = results["everything"]
    chosen = np.array([wanted(group) for group in base["groups"]])
    rng = np.random.default_rng(0)
    weights = rng.multinomial(chosen.sum(), np.full(chosen.sum(), 1.0 / chosen.sum()), 1000)
    yield "| left out | ego right | wrong | missed | error | F1 lost | all right | wrong | missed | F1 lost | ms |"
    yield "| --- " * 11 + "|"
    reference = np.array(base["counts"])[chosen]
    for name, result in results.items():
        counts = np.array(result["counts"])[chosen]
        ego, every = counts[:, :4], counts[:, 4:]
        cells = [name, *(f"{n:.0f}" for n in ego.sum(axis=0)[:3])]
        cells.append(f"{ego.sum(axis=0)[3] / max(1.0, ego.sum(axis=0)[0]):.2f}")
        for old, new in ((reference[:, :4], ego), (reference[:, 4:], every)):
            if new is every:
                cells += [f"{n:.0f}" for n in every.sum(axis=0)[:3]]
            points, low, high = loss(old, new, weights)
            cells.append(f"{points:+.2f} ({low:+.2f} to {high:+.2f})" if name != "everything" else "")
        cells.append(f"{result['cpu_ms']:.1f}")
        yield "| " + " | ".join(cells) + " |"


@click.command()
@click.option("--folder", type=click.Path(path_type=Path), default=Path("runs/ablation"), show_default=True)
@click.option("--json", "path", type=click.Path(path_type=Path), default=Path("out/ablation.json"), show_default=True)
@click.option("--only", multiple=True, help="Stages to leave out, by their names; all of them by default.")
def main(folder: Path, path: Path, only: tuple[str, ...]) -> None:
    """Print what is lost without each stage of the detector: on everything, on real frames, and on rendered ones."""
    paths = material(folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    names = [name for name in STAGES if (not only or name in only or name == "everything") and name not in results]
    with ProcessPoolExecutor(processors(), mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        jobs = {pool.submit(run_stage, name, paths): name for name in names}
        for job in as_completed(jobs):
            results[jobs[job]] = job.result()
            click.echo(f"{jobs[job]}: {results[jobs[job]]['cpu_ms']:.1f} ms", err=True)
            path.write_text(json.dumps(results))
    results = {name: results[name] for name in STAGES if name in results}
    for title, wanted in (
        ("Everything", lambda _: True),
        ("Real frames", lambda group: not group.startswith("rendered")),
        ("Rendered frames", lambda group: group.startswith("rendered")),
    ):
        click.echo(f"\n{title}\n")
        click.echo("\n".join(table(results, wanted)))


if __name__ == "__main__":
    main()
