"""Runs systems over rendered clips with exact truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

from lanestream_exporter.evaluation.tracking.answers import Answer
from lanestream_exporter.evaluation.tracking.comparison import ClipRun, without_edges
from lanestream_exporter.evaluation.tracking.systems import Answerer, System, SystemSpec
from lanestream_exporter.evaluation.tracking.truth import TruthFrame
from lanestream_exporter.scenes.tracking_clips import sample_tracking_clip

# The runs of each system by its name, in the order of the clips.
Runs = dict[str, list[ClipRun]]


@dataclass(frozen=True)
class RenderedSet:
    """The rendered clips of an evaluation: of each kind one with each seed.

    With `calibrate` systems are told the true camera except its pitch and yaw, which they estimate.
    """

    kinds: tuple[str, ...]
    seeds: range
    calibrate: bool = False

    @property
    def clips(self) -> list[tuple[str, int]]:
        """The kind and the seed of each clip."""
        return [(kind, seed) for kind in self.kinds for seed in self.seeds]


def run_rendered(
    specs: Sequence[SystemSpec], rendered: RenderedSet, jobs: int = 1, report: Callable[[str], None] = lambda _: None
) -> Runs:
    """Runs every system over every clip, in `jobs` processes; `report` is called with the name of each clip that ends.

    Raises SourceError and ModelError if a system can't be started.
    """
    clips = rendered.clips
    if jobs == 1:
        return _run_share(specs, clips, rendered.calibrate, report)
    # Neighboring clips are of one kind and take about the same time.
    shares = [clips[job::jobs] for job in range(jobs) if clips[job::jobs]]
    with ProcessPoolExecutor(len(shares), mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(_run_share, specs, share, rendered.calibrate) for share in shares]
        parts = [future.result() for future in futures]
    order = {(kind, str(seed)): index for index, (kind, seed) in enumerate(clips)}
    return {
        spec.name: sorted((run for part in parts for run in part[spec.name]), key=lambda run: order[run.kind, run.name])
        for spec in specs
    }


def _run_share(
    specs: Sequence[SystemSpec],
    clips: Sequence[tuple[str, int]],
    calibrate: bool,
    report: Callable[[str], None] = lambda _: None,
) -> Runs:
    runs: Runs = {spec.name: [] for spec in specs}
    with ExitStack() as stack:
        systems = {spec.name: stack.enter_context(closing(spec.start())) for spec in specs}
        for kind, seed in clips:
            for name, run in run_clip(systems, kind, seed, calibrate).items():
                runs[name].append(run)
            report(f"{kind} {seed}")
    return runs


def run_clip(systems: Mapping[str, System], kind: str, seed: int, calibrate: bool = False) -> dict[str, ClipRun]:
    """Runs every system over one rendered clip, and returns the runs by the systems' names."""
    runs = {name: ClipRun(kind, str(seed)) for name in systems}
    answerers: dict[str, Answerer] = {}
    for image, record in sample_tracking_clip(kind, seed).frames():
        truth = TruthFrame.from_record(record)
        if not answerers:
            camera = _told(truth.camera, calibrate)
            answerers = {name: system.open(camera) for name, system in systems.items()}
        # Every system gets the frame before the first answer is waited for, so that processes work at the same time.
        pending = {name: answer(image, truth.timestamp) for name, answer in answerers.items()}
        for name, answer in pending.items():
            runs[name].add(truth, without_edges(truth, Answer.from_message(answer())))
    return runs


def _told(camera: Mapping[str, Any], calibrate: bool) -> dict[str, Any]:
    return {**camera, "pitch": "auto", "yaw": "auto"} if calibrate else dict(camera)
