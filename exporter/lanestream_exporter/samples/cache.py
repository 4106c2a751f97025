"""Cached files of rendered scenes, written once by several processes."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import cv2

SCENES_PER_FILE = 250

# The version of rendering, of candidates and of labeling. It is part of the file names, so that files of another
# version are not used.
SAMPLES_VERSION = 5

# Hard scenes are seeded by file numbers from here on, which no file of other scenes reaches.
FIRST_HARD_FILE = 1_000_000

# The name of the data set of pictures without a road.
NO_ROAD = "pictures without a road"

# Called with a file's number, its number of scenes and its path; writes the file.
WriteScenes = Callable[[int, int, Path], object]


def scenes_per_file(scenes: int) -> list[int]:
    """Returns the number of scenes per file for `scenes` scenes in all."""
    full, rest = divmod(scenes, SCENES_PER_FILE)
    return [SCENES_PER_FILE] * full + ([rest] if rest else [])


def scene_files(
    folder: Path, kind: str, scenes: Sequence[int], write: WriteScenes, workers: int, done: Callable[[int], None]
) -> list[Path]:
    """Returns files named by `kind` and the samples' version, the n-th from `scenes[n]` scenes; writes missing ones.

    `write` must be a module-level function, because other processes call it. `done` is called with the number of scenes
    of each file when it is finished.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{kind}-{SAMPLES_VERSION}-{number:04d}-{count}.npz" for number, count in enumerate(scenes)]
    missing = [number for number, path in enumerate(paths) if not path.exists()]
    done(sum(scenes) - sum(scenes[number] for number in missing))
    # Spawned, because a forked OpenCV or torch may wait for threads that do not exist after a fork.
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_start_worker)
    try:
        running = {pool.submit(write, number, scenes[number], paths[number]): number for number in missing}
        for future in as_completed(running):
            future.result()
            done(scenes[running[future]])
    finally:
        pool.shutdown(cancel_futures=True)
    return paths


def _start_worker() -> None:
    """Leaves interrupts to the parent process and uses one thread, because there is one process per CPU."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
