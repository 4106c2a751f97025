"""`make soak`: a service under cameras that stream, stall, leave, come back and send rubbish, at random, for minutes.

Ends with an error where a promise is broken: an answer left out or given twice, ids that change over a resume, memory
that grows, threads or tasks that stay behind.
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
from soak_camera import FRAME_S, BrokenPromiseError, Camera

from lanestream.local import LocalEngine
from lanestream.protocol import LanesMessage
from lanestream_exporter.scenes import render_still, sample_scene

_EVERY_S = 1.0
_SIZE = (640, 360)
_SURE = 0.8
# Shares of the run that count as the warm-up, and at either end of what follows it as the beginning and the end.
_WARM, _ENDS = 1 / 3, 0.15


@dataclass(frozen=True)
class Vitals:
    """The service at one moment, with its worker processes."""

    seconds: float
    memory_mb: float
    threads: int
    tasks: int
    sessions: int


def vitals(process: int, url: str, seconds: float) -> Vitals:
    """What the system and the service itself say of it."""
    service = psutil.Process(process)
    everything = [service, *service.children(recursive=True)]
    lines = httpx.get(f"{url}/metrics").text.splitlines()
    told = dict(line.rsplit(" ", 1) for line in lines if not line.startswith("#"))
    memory = sum(each.memory_info().rss for each in everything) / 2**20
    threads = sum(each.num_threads() for each in everything)
    sessions, tasks = (int(float(told[name])) for name in ("lane_sessions_active", "lane_tasks"))
    return Vitals(seconds, memory, threads, tasks, sessions)


def cameras(url: str, count: int, seed: int) -> list[Camera]:
    """Cameras over rendered roads, half of them in mode `all`."""
    too_large = cv2.imencode(".png", np.zeros((4096, 4096), np.uint8))[1].tobytes()
    return [
        Camera(f"camera-{i}", url, ("all", "latest")[i % 2], picture, too_large, random.Random(seed + i))  # noqa: S311
        for i, picture in enumerate(pictures(count, seed))
    ]


def pictures(count: int, seed: int) -> list[bytes]:
    """JPEG files of rendered roads whose ego lane is surely seen again and again: ids have no reason to change."""
    engine = LocalEngine.load(None, "auto")
    rng = np.random.default_rng(seed)
    found: list[bytes] = []
    while len(found) < count:
        image = cv2.resize(render_still(sample_scene(rng, 1280, 720)).image, _SIZE, interpolation=cv2.INTER_AREA)
        picture = cv2.imencode(".jpg", image)[1].tobytes()
        camera = engine.open_camera()
        # Frames that follow each other closely, then ones with gaps as they are when most are dropped.
        times = np.cumsum([FRAME_S] * 12 + [0.3] * 12)
        seen = [camera.lanes(picture, seq=i, timestamp=time) for i, time in enumerate(times.tolist())]
        egos = {(told.ego.left, told.ego.right) for told in seen}
        if len(egos) == 1 and all(_is_sure(told) for told in seen):
            found.append(picture)
    return found


def _is_sure(told: LanesMessage) -> bool:
    """Whether both boundaries of the ego lane were found, and not by a hair."""
    return sum(lane.position in (-1, 1) and lane.probability > _SURE for lane in told.lanes) == 2


async def soak(url: str, process: int, crew: list[Camera], seconds: float) -> list[Vitals]:
    """Lets the cameras live for `seconds`, and a little more for the service to come to rest; its vitals meanwhile."""
    began = time.monotonic()
    seen = []
    async with asyncio.TaskGroup() as group:
        for camera in crew:
            group.create_task(camera.live(began + seconds))
        while (now := time.monotonic() - began) < seconds:
            seen.append(await asyncio.to_thread(vitals, process, url, now))
            await asyncio.sleep(_EVERY_S)
    await asyncio.sleep(2.0)
    return [*seen, await asyncio.to_thread(vitals, process, url, time.monotonic() - began)]


def findings(seen: list[Vitals], before: Vitals) -> dict[str, float | int]:
    """Growth of memory after the warm-up in percent, and what was left when all cameras had gone."""
    total = seen[-1].seconds
    after = [each for each in seen[:-1] if each.seconds >= _WARM * total]
    part = max(1, round(_ENDS * len(after)))
    start, end = (statistics.median(each.memory_mb for each in some) for some in (after[:part], after[-part:]))
    return {
        "memory_mb_after_warm_up": round(start, 1),
        "memory_mb_at_the_end": round(end, 1),
        "memory_growth_percent": round(100.0 * (end - start) / start, 2),
        # Pools grow to their size in the warm-up; from then on nothing may be added.
        "threads_left": seen[-1].threads - max(each.threads for each in seen if each not in after),
        "tasks_left": seen[-1].tasks - before.tasks,
        "sessions_left": seen[-1].sessions,
    }


@click.command()
@click.option("--minutes", type=click.FloatRange(min=0.05), default=3.0, show_default=True)
@click.option("--sessions", type=click.IntRange(1, 64), default=16, show_default=True)
@click.option("--seed", type=int, default=1, show_default=True)
@click.option("--json", "path", type=click.Path(path_type=Path), default=Path("out/soak.json"), show_default=True)
def main(minutes: float, sessions: int, seed: int, path: Path) -> None:
    """Runs the soak and writes what it saw."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with service_process(path.with_suffix(".log")) as (running, url):
        process = running.pid
        crew = cameras(url, sessions, seed)
        httpx.post(f"{url}/v1/detect", content=crew[0].picture).raise_for_status()
        before = vitals(process, url, 0.0)
        try:
            seen = asyncio.run(soak(url, process, crew, 60.0 * minutes))
        except* BrokenPromiseError as broken:
            sys.exit(
                f"error: a promise was broken: {broken.exceptions[0]} (seed {seed}; see {path.with_suffix('.log')})"
            )
    counts: Counter[str] = sum((camera.counts for camera in crew), Counter())
    found = findings(seen, before)
    told = {"minutes": minutes, "sessions": sessions, "seed": seed, **found, "frames": dict(sorted(counts.items()))}
    path.write_text(json.dumps({**told, "vitals": [asdict(each) for each in seen]}, indent=2) + "\n", encoding="utf-8")
    click.echo(json.dumps(told, indent=2))
    if (
        found["memory_growth_percent"] >= 5.0
        or found["threads_left"] > 0
        or found["tasks_left"] > 0
        or found["sessions_left"]
    ):
        sys.exit("error: the service grew, or kept something")


if __name__ == "__main__":
    main()
