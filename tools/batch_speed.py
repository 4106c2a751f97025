"""`make batch-speed`: how much of what the processors could do `lanestream batch` does, on the same videos.

It is compared with bare engines: one process per processor that decodes the videos and finds their lanes, without
results, records or progress. Neither counts the time until the first engines are loaded. Both run in every round, so
that a busy machine slows both, and only ratios within a round count.
"""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from multiprocessing import get_context
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Barrier
from pathlib import Path
from queue import Empty
from statistics import median
from typing import Any, Final

import click
import cv2
import numpy as np

from lanestream.host import processors
from lanestream.local import LocalEngine
from lanestream_client.sinks import video_sink
from lanestream_client.video_sources import open_video_file
from lanestream_exporter.scenes import Drive, render_clip, sample_clip

SEED: Final = 24
FPS: Final = 25.0


@click.command()
@click.argument("videos", nargs=-1, type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--rounds", type=click.IntRange(1), default=3, show_default=True)
@click.option("--copies", type=click.IntRange(1), default=16, show_default=True, help="Copies of each video.")
@click.option("--format", "output_format", type=click.Choice(["jsonl", "parquet"]), default="jsonl", show_default=True)
def main(videos: tuple[Path, ...], rounds: int, copies: int, output_format: str) -> None:
    """Compare batch with bare engines on copies of VIDEOS  [default: a rendered drive]."""
    with tempfile.TemporaryDirectory() as folder:
        archive = Path(folder, "archive")
        archive.mkdir()
        for number, video in enumerate(videos or [rendered(Path(folder, "drive.mp4"))]):
            for copy in range(copies):
                shutil.copy(video, archive / f"{number}-{copy}{video.suffix}")
        ratios, costs = [], []
        for number in range(rounds):
            bare, bare_cpu_s = bare_engines(sorted(archive.iterdir()))
            batch, batch_cpu_s = whole_batch(archive, Path(folder, f"out{number}"), output_format)
            ratios.append(batch / bare)
            costs.append(bare_cpu_s / batch_cpu_s)
            click.echo(
                f"round {number + 1}: bare engines {bare:.1f} frames/s, batch {batch:.1f} frames/s: {ratios[-1]:.3f}; "
                f"processor time per frame {1e3 * bare_cpu_s:.1f} ms and {1e3 * batch_cpu_s:.1f} ms: {costs[-1]:.3f}"
            )
    click.echo(f"batch / bare engines, median: {median(ratios):.3f} of the frames/s")
    click.echo(f"bare engines / batch, median: {median(costs):.3f} of the processor time per frame")


def rendered(path: Path) -> Path:
    """Renders a drive of four seconds, 1280 x 720."""
    clip = sample_clip(
        np.random.default_rng(SEED), 1280, 720, frames=100, fps=FPS, drive=Drive("highway", lane_change=True, fair=True)
    )
    with video_sink(path, FPS) as sink:
        assert sink is not None  # noqa: S101 - has a path
        for frame in render_clip(clip):
            sink.write(frame.image, frame.timestamp)
    return path


def whole_batch(archive: Path, out: Path, output_format: str) -> tuple[float, float]:
    """Runs the command. Returns its frames per second, and its processor time per frame in seconds."""
    used = children_s()
    command = [sys.executable, "-m", "lanestream.cli", "batch", str(archive), "--out", str(out)]
    subprocess.run([*command, "--format", output_format], check=True, stdout=subprocess.DEVNULL)
    run: dict[str, Any] = json.loads((out / "summary.json").read_text())["this_run"]
    return run["frames_per_s"], (children_s() - used) / run["frames"]


def bare_engines(videos: list[Path]) -> tuple[float, float]:
    """Runs bare engines. Returns their frames per second, and their processor time per frame in seconds."""
    used = children_s()
    context = get_context("spawn")
    ready = context.Barrier(processors() + 1)
    work, done = context.Queue(), context.SimpleQueue()
    for video in videos:
        work.put(video)
    workers = [context.Process(target=find_lanes, args=(ready, work, done)) for _ in range(processors())]
    for worker in workers:
        worker.start()
    ready.wait()
    began = time.monotonic()
    frames = sum(done.get() for _ in workers)
    seconds = time.monotonic() - began
    for worker in workers:
        worker.join()
    return frames / seconds, (children_s() - used) / frames


def find_lanes(ready: Barrier, work: Any, done: SimpleQueue[int]) -> None:
    """Finds the lanes in videos until there are no more; the target of a process."""
    engine = LocalEngine.load(None, "auto", threads=1)
    cv2.setNumThreads(1)
    frames = 0
    ready.wait()
    while True:
        try:
            video = work.get(timeout=0.1)
        except Empty:
            break
        camera = engine.open_camera()
        with open_video_file(str(video), threads=1) as source:
            for frame in source.frames:
                assert frame.pixels is not None and frame.timestamp is not None  # noqa: PT018, S101 - of a video
                camera.lanes(frame.pixels, seq=frame.seq, timestamp=frame.timestamp)
                frames += 1
    done.put(frames)


def children_s() -> float:
    """Returns the processor time of all child processes that have ended, in seconds."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main()
