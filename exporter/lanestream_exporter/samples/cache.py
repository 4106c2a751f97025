"""Files of rendered scenes, made by several processes, once, and kept in a folder."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import cv2

SCENES_PER_FILE = 250

# Of what is rendered and how it is labelled; part of the files' names, so that those of another edition are not used.
EDITION = 3

# Writes the file with that number, of so many scenes, to that path.
Write = Callable[[int, int, Path], object]


def files_of(scenes: int) -> list[int]:
    """How `scenes` scenes are shared out among files."""
    full, rest = divmod(scenes, SCENES_PER_FILE)
    return [SCENES_PER_FILE] * full + ([rest] if rest else [])


def scene_files(
    folder: Path, kind: str, scenes: Sequence[int], write: Write, workers: int, done: Callable[[int], None]
) -> list[Path]:
    """Files named by their `kind` and edition, the n-th of `scenes[n]` scenes, made by `write` where they are missing.

    `write` is a module's function, because other processes call it. `done` is called with the number of scenes of each
    file as it is finished.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{kind}-{EDITION}-{number:04d}-{count}.npz" for number, count in enumerate(scenes)]
    missing = [number for number, path in enumerate(paths) if not path.exists()]
    done(sum(scenes) - sum(scenes[number] for number in missing))
    # Spawned, because a forked OpenCV or torch may wait for threads that the fork left behind.
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_begin)
    try:
        running = {pool.submit(write, number, scenes[number], paths[number]): number for number in missing}
        for future in as_completed(running):
            future.result()
            done(scenes[running[future]])
    finally:
        pool.shutdown(cancel_futures=True)
    return paths


def _begin() -> None:
    """Leaves interrupts to the parent, and the other processors to the other processes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
