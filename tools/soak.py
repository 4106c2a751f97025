"""`make soak`: runs a service for minutes with cameras that stream, stall, disconnect, resume and send invalid data.

Ends with an error if a guarantee is violated: a missing or repeated answer, track ids that change at a resume, growing
memory, or threads, tasks or sessions that are left at the end.
"""

from __future__ import annotations

import asyncio
import json
import random
import statistics
import sys
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import click
import cv2
import httpx
import numpy as np
import psutil
from demo import service_process
from soak_camera import FRAME_S, GuaranteeError, SoakCamera

from lanestream.local import LocalEngine
from lanestream.protocol import LanesMessage
from lanestream_exporter.scenes import render_still, sample_scene

_SAMPLE_EVERY_S = 1.0
_SIZE = (640, 360)
_MIN_PROBABILITY = 0.8
# The warm-up as a fraction of the run, and the parts to compare as a fraction of the rest, at both of its ends.
_WARM_UP, _ENDS = 1 / 3, 0.15


@dataclass(frozen=True)
class ResourceSample:
    """The resources of the service and its worker processes at one moment."""

    seconds: float
    memory_mb: float
    threads: int
    tasks: int
    sessions: int


def sample_resources(process: int, url: str, seconds: float) -> ResourceSample:
    """Returns the resources that the system and the service's metrics report."""
    service = psutil.Process(process)
    processes = [service, *service.children(recursive=True)]
    lines = httpx.get(f"{url}/metrics").text.splitlines()
    metrics = dict(line.rsplit(" ", 1) for line in lines if not line.startswith("#"))
    memory = sum(each.memory_info().rss for each in processes) / 2**20
    threads = sum(each.num_threads() for each in processes)
    sessions, tasks = (int(float(metrics[name])) for name in ("lane_sessions_active", "lane_tasks"))
    return ResourceSample(seconds, memory, threads, tasks, sessions)


def make_cameras(url: str, count: int, seed: int) -> list[SoakCamera]:
    """Returns cameras that show rendered roads, half of them in mode `all`."""
    too_large = cv2.imencode(".png", np.zeros((4096, 4096), np.uint8))[1].tobytes()
    return [
        SoakCamera(f"camera-{i}", url, ("all", "latest")[i % 2], image, too_large, random.Random(seed + i))  # noqa: S311
        for i, image in enumerate(stable_images(count, seed))
    ]


def stable_images(count: int, seed: int) -> list[bytes]:
    """Returns JPEG files of rendered roads whose ego lane is found reliably, so that its track ids must not change."""
    engine = LocalEngine.load(None, "auto")
    rng = np.random.default_rng(seed)
    found: list[bytes] = []
    while len(found) < count:
        image = cv2.resize(render_still(sample_scene(rng, 1280, 720)).image, _SIZE, interpolation=cv2.INTER_AREA)
        jpeg = cv2.imencode(".jpg", image)[1].tobytes()
        camera = engine.open_camera()
        # Frames at a normal rate, then with gaps as if most of them were dropped.
        times = np.cumsum([FRAME_S] * 12 + [0.3] * 12)
        answers = [camera.lanes(jpeg, seq=i, timestamp=time) for i, time in enumerate(times.tolist())]
        egos = {(answer.ego.left, answer.ego.right) for answer in answers}
        if len(egos) == 1 and all(map(_is_reliable, answers)):
            found.append(jpeg)
    return found


def _is_reliable(answer: LanesMessage) -> bool:
    """Returns whether both boundaries of the ego lane were found with a high probability."""
    return sum(lane.position in (-1, 1) and lane.probability > _MIN_PROBABILITY for lane in answer.lanes) == 2


async def soak(url: str, process: int, cameras: list[SoakCamera], seconds: float) -> list[ResourceSample]:
    """Runs the cameras for `seconds` and returns samples of the resources, the last one after a short rest."""
    began = time.monotonic()
    samples = []
    async with asyncio.TaskGroup() as group:
        for camera in cameras:
            group.create_task(camera.run(began + seconds))
        while (now := time.monotonic() - began) < seconds:
            samples.append(await asyncio.to_thread(sample_resources, process, url, now))
            await asyncio.sleep(_SAMPLE_EVERY_S)
    await asyncio.sleep(2.0)
    return [*samples, await asyncio.to_thread(sample_resources, process, url, time.monotonic() - began)]


def growth(samples: list[ResourceSample], before: ResourceSample) -> dict[str, float | int]:
    """Returns the growth of memory after the warm-up in percent, and what is left when all cameras are gone."""
    total = samples[-1].seconds
    after = [each for each in samples[:-1] if each.seconds >= _WARM_UP * total]
    part = max(1, round(_ENDS * len(after)))
    start, end = (statistics.median(each.memory_mb for each in end) for end in (after[:part], after[-part:]))
    return {
        "memory_mb_after_warm_up": round(start, 1),
        "memory_mb_at_the_end": round(end, 1),
        "memory_growth_percent": round(100.0 * (end - start) / start, 2),
        # Thread pools reach their size in the warm-up. After that no thread may be added.
        "threads_left": samples[-1].threads - max(each.threads for each in samples if each not in after),
        "tasks_left": samples[-1].tasks - before.tasks,
        "sessions_left": samples[-1].sessions,
    }


@click.command()
@click.option("--minutes", type=click.FloatRange(min=0.05), default=3.0, show_default=True)
@click.option("--sessions", type=click.IntRange(1, 64), default=16, show_default=True)
@click.option("--seed", type=int, default=1, show_default=True)
@click.option("--json", "path", type=click.Path(path_type=Path), default=Path("out/soak.json"), show_default=True)
def main(minutes: float, sessions: int, seed: int, path: Path) -> None:
    """Run the soak and write its report."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with service_process(path.with_suffix(".log")) as (running, url):
        process = running.pid
        cameras = make_cameras(url, sessions, seed)
        httpx.post(f"{url}/v1/detect", content=cameras[0].image).raise_for_status()
        before = sample_resources(process, url, 0.0)
        try:
            samples = asyncio.run(soak(url, process, cameras, 60.0 * minutes))
        except* GuaranteeError as errors:
            log = path.with_suffix(".log")
            sys.exit(f"error: a guarantee was violated: {errors.exceptions[0]} (seed {seed}; see {log})")
    counts: Counter[str] = sum((camera.counts for camera in cameras), Counter())
    found = growth(samples, before)
    report = {"minutes": minutes, "sessions": sessions, "seed": seed, **found, "frames": dict(sorted(counts.items()))}
    path.write_text(
        json.dumps({**report, "samples": [asdict(each) for each in samples]}, indent=2) + "\n", encoding="utf-8"
    )
    click.echo(json.dumps(report, indent=2))
    if (
        found["memory_growth_percent"] >= 5.0
        or found["threads_left"] > 0
        or found["tasks_left"] > 0
        or found["sessions_left"]
    ):
        sys.exit("error: the memory grew, or threads, tasks or sessions are left")


if __name__ == "__main__":
    main()
