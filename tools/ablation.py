"""Measures what each stage of the candidate detector is worth: every stage is left out once, the others as served.

Material: labeled training and validation frames as single images, clips of these splits as streams, rendered scenes as
single images, and rendered drives as streams, with seeds that no training run uses. The test split is never read. All
runs see the same frames, so differences are paired; their intervals come from a bootstrap over images and drives.
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
from typing import Any, Final
from unittest.mock import patch

import click
import cv2
import numpy as np

from lanestream.detection import candidate_detector, curve_fit, ego_prior, proposals, vanishing_point
from lanestream.detection.ego_prior import EgoPrior, LaneSpacing
from lanestream.engine import Engine, load_engine
from lanestream.errors import LanestreamError
from lanestream.host import processors
from lanestream.inference.providers import RuntimeOptions
from lanestream.road.curve import Curves
from lanestream_exporter.datasets.labels import LabeledFrame
from lanestream_exporter.datasets.manifest import DatasetCollection, LabeledClip
from lanestream_exporter.evaluation.boundaries import FrameMatches, ReportedBoundary, match, match_ego
from lanestream_exporter.evaluation.steadiness import steadiness
from lanestream_exporter.scenes import render_still, sample_scene
from lanestream_exporter.scenes.clip import render_clip, sample_clip

SCENES: Final = 480
SCENES_PER_FILE: Final = 40
DRIVES: Final = 48
DRIVE_FRAMES: Final = 50
FPS: Final = 20.0
SIZES: Final = ((640, 360), (640, 480), (960, 540), (1280, 720))
# Training seeds begin with the number of a file of scenes, which is below ten thousand.
SEED: Final = 31_415_926
# Of a longer clip so many frames are used as a stream.
CLIP_FRAMES: Final = 800
BASELINE: Final = "nothing"

# Replaces parts of the detector for the length of the stack, and may replace the engine.
Leave = Callable[[Engine, ExitStack], Engine]


@dataclass(frozen=True)
class FrameSequence:
    """An image or a drive: JPEG files with their frame rate, and the labels by frame number."""

    group: str
    frames: tuple[bytes, ...]
    fps: float
    labels: dict[int, LabeledFrame]


def _replace(module: Any, name: str, new: Any) -> Leave:
    """Returns what replaces `name` in a module or class by `new`."""

    def leave(engine: Engine, stack: ExitStack) -> Engine:
        stack.enter_context(patch.object(module, name, new))
        return engine

    return leave


def _without_regressor(engine: Engine, stack: ExitStack) -> Engine:
    del stack
    return Engine.of({"classifier": engine.models["classifier"]})


def _propose(**changes: Any) -> Leave:
    """Returns what calls `propose` without the given arguments."""
    real = proposals.propose

    def propose(channels: Any, context: Any, prior: Any, fitted: Any, limit: int = proposals.MOST_CANDIDATES) -> Any:
        # Tracked boundaries are still accepted more easily.
        searched = replace(context, tracked=None) if "tracked" in changes else context
        found = real(channels, searched, prior, None if "fitted" in changes else fitted, limit)
        return replace(found, tracked=context.tracked)

    return _replace(candidate_detector, "propose", propose)


def _without_lines(ridges: Any, point: Any, width: int) -> Any:
    del ridges, point, width
    return vanishing_point.FoundLines(np.empty(0), np.empty(0))


def _without_own_boundaries(engine: Engine, stack: ExitStack) -> Engine:
    """Proposes the next lanes beside the prior's boundaries, but not these."""
    real = Curves.concatenate

    def concatenate(parts: Any) -> Curves:
        if len(parts) == 4:  # prior's, next lanes, tracked, found
            parts = [Curves.none(parts[0].horizon), *parts[1:]]
        return real(parts)

    stack.enter_context(patch.object(Curves, "concatenate", concatenate))
    return engine


STAGES: Final[dict[str, Leave | None]] = {
    BASELINE: None,
    "ego-lane prior": _without_regressor,
    "mirrored crop of an uncertain regressor": _replace(ego_prior, "_UNCERTAIN", np.inf),
    "refined vanishing point": _replace(proposals, "refine", lambda guess, *_: guess),
    "lines through the vanishing point": _replace(proposals, "find_lines", _without_lines),
    "tracked boundaries as candidates": _propose(tracked=None),
    "prior's boundaries as candidates": _without_own_boundaries,
    "prior's boundaries on the paint as candidates": _propose(fitted=None),
    "steps between surfaces as candidates": _replace(proposals, "_LEAST_STEPS", np.inf),
    "next lanes as candidates": _replace(LaneSpacing, "neighbors", np.empty(0)),
    "lane-spacing weight of lines": _replace(proposals, "_UNSPACED_SHARE", 1.0),
    "least strength of lines": _replace(proposals, "_LEAST_STRENGTH", 0.0),
    "prior's odds": _replace(EgoPrior, "odds", lambda self, curves: np.ones((len(curves), 2))),
    "mean of candidates that agree": _replace(
        candidate_detector, "_means", lambda curves, probability, gaps, chosen, view: curves.take(chosen)
    ),
    "curve fit": _replace(
        candidate_detector,
        "fit_curves",
        lambda channels, curves, spans, view, is_edge: curve_fit.Fits(
            curves, np.tile(np.diag([4.0, 4e-4, 4e4]), (len(curves), 1, 1)), np.ones(len(curves)), view
        ),
    ),
    "common road in the fit": _replace(curve_fit, "_COMMON_SIGMA", np.array([9.0, 9.0])),
    "common horizon in the fit": _replace(curve_fit, "_ROAD_SIGMA", np.array([0.1, 1e-6, 0.03])),
    "middle of double lines": _replace(
        curve_fit, "_stripe_shifts", lambda gray, fits, top, bottom: np.zeros(len(fits.curves))
    ),
    "separation of boundaries": _replace(candidate_detector, "_CLOSEST", -1.0),
}


def make_material(folder: Path, data: Path | None) -> list[Path]:
    """Returns the files of sequences in `folder`, and makes missing ones. Raises LabelError without real frames."""
    DatasetCollection.open(None, data).require_splits("train", "val")  # first, because rendering takes long
    folder.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(processors(), mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(_real_file, folder, data)]
        jobs += [pool.submit(_scenes_file, folder, number) for number in range(0, SCENES, SCENES_PER_FILE)]
        jobs += [pool.submit(_drive_file, folder, number) for number in range(DRIVES)]
        return [job.result() for job in jobs]


def _write(path: Path, make: Callable[[], list[FrameSequence]]) -> Path:
    if not path.exists():
        cv2.setNumThreads(1)
        unfinished = path.with_suffix(".unfinished")
        unfinished.write_bytes(pickle.dumps(make()))
        unfinished.rename(path)
    return path


def _jpeg(image: Any) -> bytes:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def _scenes_file(folder: Path, first: int) -> Path:
    def make() -> list[FrameSequence]:
        sequences = []
        for number in range(first, first + SCENES_PER_FILE):
            still = render_still(sample_scene(np.random.default_rng([SEED, 0, number]), *SIZES[number % len(SIZES)]))
            sequences.append(FrameSequence("rendered scenes", (_jpeg(still.image),), 1.0, {0: still.labels}))
        return sequences

    return _write(folder / f"scenes-{first:04d}.pickle", make)


def _drive_file(folder: Path, number: int) -> Path:
    def make() -> list[FrameSequence]:
        rng = np.random.default_rng([SEED, 1, number])
        frames = list(render_clip(sample_clip(rng, *SIZES[number % len(SIZES)], DRIVE_FRAMES, FPS)))
        labels = {index: frame.labels for index, frame in enumerate(frames)}
        return [FrameSequence("rendered drives", tuple(_jpeg(frame.image) for frame in frames), FPS, labels)]

    return _write(folder / f"drive-{number:04d}.pickle", make)


def _real_file(folder: Path, data: Path | None) -> Path:
    def make() -> list[FrameSequence]:
        datasets = DatasetCollection.open(None, data)
        sequences = []
        for split in ("train", "val"):
            for frame, image in datasets.frames(split):
                sequences.append(FrameSequence(f"{frame.group} images", (_jpeg(image),), 1.0, {0: frame}))
            sequences += [_stream(clip) for clip in datasets.clips(split)]
        return sequences

    return _write(folder / "real.pickle", make)


def _stream(clip: LabeledClip) -> FrameSequence:
    video = cv2.VideoCapture(str(clip.video))
    fps = video.get(cv2.CAP_PROP_FPS)
    first, last = clip.frames.start, min(clip.frames.stop, clip.frames.start + CLIP_FRAMES)
    video.set(cv2.CAP_PROP_POS_FRAMES, first)
    frames: list[bytes] = []
    while len(frames) < last - first:
        is_read, image = video.read()
        if not is_read:
            break
        frames.append(_jpeg(image))
    labels = {index - first: frame for index, frame in clip.labeled.items() if first <= index < last}
    return FrameSequence(f"{clip.name} stream", tuple(frames), fps, labels)


def run(stage: str, paths: list[Path]) -> dict[str, Any]:
    """Returns the counts of every sequence without a `stage`, and the CPU time per frame in milliseconds.

    Counts are right, wrong, missed and the sum of errors (pixels at 640 wide) of ego boundaries, then of all. Streams
    are frames with both ego boundaries, and the number of samples of the jitter with their sum of squares.
    """
    cv2.setNumThreads(1)
    engine = load_engine(provider="cpu", options=RuntimeOptions(threads=1))
    groups, counts, streams, spent, frames = [], [], [], 0.0, 0
    with ExitStack() as stack:
        leave = STAGES[stage]
        engine = engine if leave is None else leave(engine, stack)
        for path in paths:
            for sequence in pickle.loads(path.read_bytes()):  # noqa: S301 - our own file
                session = engine.open_session()
                total = np.zeros(8)
                reported: list[tuple[ReportedBoundary, ...]] = []
                size = 1, 1
                for index, data in enumerate(sequence.frames):
                    image = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), np.uint8)
                    started = time.process_time()
                    result = engine.process(session, image, index / sequence.fps)
                    spent += time.process_time() - started
                    frames += 1
                    reports = tuple(ReportedBoundary.from_lane(lane) for lane in result.lanes)
                    reported.append(reports)
                    size = image.shape[1], image.shape[0]
                    label = sequence.labels.get(index)
                    if label is not None:
                        total += _counts(match_ego(reports, label)) + _counts(match(reports, label.lanes, label))
                groups.append(sequence.group)
                counts.append(total.tolist())
                steady = steadiness(reported, (), size)
                samples = steady["jitter_samples"]
                streams.append([steady["both_ego_frames"], samples, samples * (steady["jitter_px_640"] or 0.0) ** 2])
    return {"groups": groups, "counts": counts, "streams": streams, "cpu_ms": 1e3 * spent / frames}


def _counts(matches: FrameMatches) -> list[float]:
    return [
        len(matches.matches), matches.wrong, matches.missed, sum(each.error for each in matches.matches),
    ]  # fmt: skip


def f1(counts: Any) -> Any:
    """Returns F1 (...) in percent of counts (..., 4): right, wrong, missed, sum of errors."""
    right, wrong, missed = counts[..., 0], counts[..., 1], counts[..., 2]
    return 200.0 * right / np.maximum(2.0 * right + wrong + missed, 1.0)


def table(results: dict[str, dict[str, Any]], wanted: Callable[[str], bool]) -> Iterator[str]:
    """Yields the lines of a Markdown table of all stages over the groups that are `wanted`."""
    base = results[BASELINE]
    chosen = np.array([wanted(group) for group in base["groups"]])
    number = int(chosen.sum())
    weights = np.random.default_rng(0).multinomial(number, np.full(number, 1.0 / number), 1000)
    yield (
        "| left out | ego right | wrong | missed | error, px | F1 lost | all right | wrong | missed | F1 lost | "
        "frames with both ego boundaries | jitter, px | CPU, ms |"
    )
    yield "| --- " * 13 + "|"
    reference = np.array(base["counts"])[chosen]
    for name, result in results.items():
        counts = np.array(result["counts"])[chosen]
        cells = [name]
        for part, with_error in ((slice(0, 4), True), (slice(4, 8), False)):
            right, wrong, missed, error = counts[:, part].sum(axis=0)
            cells += [f"{right:.0f}", f"{wrong:.0f}", f"{missed:.0f}"]
            cells += [f"{error / max(right, 1.0):.2f}"] if with_error else []
            cells.append("" if name == BASELINE else _loss(reference[:, part], counts[:, part], weights))
        both, samples, squares = np.array(result["streams"])[chosen].sum(axis=0)
        cells += [f"{both:.0f}", f"{np.sqrt(squares / max(samples, 1.0)):.2f}", f"{result['cpu_ms']:.1f}"]
        yield "| " + " | ".join(cells) + " |"


def _loss(base: Any, other: Any, weights: Any) -> str:
    """Returns the points of F1 that `other` (N, 4) loses against `base`, with the 95 % interval over sequences."""
    low, high = np.percentile(f1(weights @ base) - f1(weights @ other), [2.5, 97.5])
    return f"{f1(base.sum(axis=0)) - f1(other.sum(axis=0)):+.2f} ({low:+.2f} to {high:+.2f})"


@click.command()
@click.option("--folder", type=click.Path(path_type=Path), default=Path("runs/ablation"), show_default=True)
@click.option("--data", type=click.Path(path_type=Path), help="Folder of the real frames  [default: LANESTREAM_DATA]")
@click.option("--json", "path", type=click.Path(path_type=Path), default=Path("out/ablation.json"), show_default=True)
@click.option("--only", multiple=True, metavar="STAGE", help="Leave out only these stages; may be repeated.")
def main(folder: Path, data: Path | None, path: Path, only: tuple[str, ...]) -> None:
    """Print what is lost without each stage, on all frames, on real ones and on rendered ones.

    Stages that PATH already has results for are not run again.
    """
    unknown = sorted(set(only) - set(STAGES))
    if unknown:
        raise click.BadParameter(f"{unknown[0]!r} is not one of: {', '.join(STAGES)}", param_hint="--only")
    try:
        files = make_material(folder, data)
    except LanestreamError as error:
        raise click.ClickException(str(error)) from error
    path.parent.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    missing = [name for name in (BASELINE, *(only or STAGES)) if name not in results]
    with ProcessPoolExecutor(processors(), mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        jobs = {pool.submit(run, name, files): name for name in dict.fromkeys(missing)}
        for job in as_completed(jobs):
            results[jobs[job]] = job.result()
            click.echo(f"without {jobs[job]}: {results[jobs[job]]['cpu_ms']:.1f} ms a frame", err=True)
            path.write_text(json.dumps(results), encoding="utf-8")
    results = {name: results[name] for name in STAGES if name in results}
    for title, wanted in (
        ("All frames", lambda group: True),
        ("Real frames", lambda group: not group.startswith("rendered")),
        ("Rendered frames", lambda group: group.startswith("rendered")),
    ):
        click.echo(f"\n{title}\n")
        click.echo("\n".join(table(results, wanted)))


if __name__ == "__main__":
    main()
