"""Compares two revisions on the same frames: speed, time to the first answer, memory, and how their answers differ.

python tools/compare.py --base REVISION drive.mp4

The base is a git worktree of REVISION in a temporary folder; the other side is the present tree as it is, with its
uncommitted changes. Both run with the same Python and the same installed packages, each in processes of its own on one
processor. They alternate in every round, so that a busy machine slows both, and only ratios within a round count.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from statistics import mean, median
from typing import Any, Final

import click
import cv2
import httpx
import numpy as np
import psutil
from demo import free_port, stop

ROOT: Final = Path(__file__).resolve().parents[1]
DETECTORS: Final = ("candidates", "regression")
SIDES: Final = ("base", "present")
PACKAGE_FOLDERS: Final = ("service", "exporter", "client")
JPEG_QUALITY: Final = 95
# Frames of a folder have no times, and some videos have no frame rate.
DEFAULT_FPS: Final = 25.0
# Differences of columns are in pixels of an image of this width; smaller ones than the tolerance are rounding.
COMPARED_WIDTH: Final = 640
TOLERANCE_PX: Final = 0.05
READY_S: Final = 120.0
SERVICE_PROCESSES: Final = 2
SERVICE_FRAMES: Final = 20

# One image file and its timestamp in seconds.
Frame = tuple[bytes, float]


class CompareError(Exception):
    """Something that ends the comparison."""


@dataclass(frozen=True)
class Pair:
    """A quantity of both sides: the medians over rounds, and the median, least and greatest ratio present / base."""

    base: float
    present: float
    ratio: float
    ratio_min: float
    ratio_max: float

    @classmethod
    def of(cls, base: Sequence[float], present: Sequence[float]) -> Pair:
        """Returns the pair for one value of each side per round, in the order of the rounds."""
        ratios = [new / old for old, new in zip(base, present, strict=True)]
        return cls(median(base), median(present), median(ratios), min(ratios), max(ratios))


@dataclass
class Differences:
    """How the answers of both sides differ.

    `frames_with_other_lanes` have other track ids or positions. `frames_with_other_columns` have the same lanes, some
    of them more than the tolerance apart. `largest_px_at_640` is the greatest distance between the columns of a
    boundary that both sides found, by position.
    """

    frames: int = 0
    frames_with_other_lanes: int = 0
    frames_with_other_columns: int = 0
    largest_px_at_640: float = 0.0

    def add(self, base: Mapping[str, Any], present: Mapping[str, Any]) -> None:
        """Counts one frame, by the `width` and the `lanes` of both answers."""
        self.frames += 1
        columns = max_column_difference(base, present)
        self.largest_px_at_640 = max(self.largest_px_at_640, columns)
        if _lane_names(base) != _lane_names(present):
            self.frames_with_other_lanes += 1
        elif columns > TOLERANCE_PX:
            self.frames_with_other_columns += 1


def max_column_difference(base: Mapping[str, Any], present: Mapping[str, Any]) -> float:
    """Returns the greatest distance between the columns of the boundaries at the same position, in pixels at 640 wide.

    Columns are compared at the base's rows, as far as both boundaries reach. Returns 0 if no position is in both.
    """
    others = {lane["position"]: _points(lane) for lane in present["lanes"]}
    greatest = 0.0
    for lane in base["lanes"]:
        rows, columns = _points(lane)
        other_rows, other_columns = others.get(lane["position"], (np.empty(0), np.empty(0)))
        if not len(rows) or not len(other_rows):
            continue
        common = (rows >= other_rows[0]) & (rows <= other_rows[-1])
        if common.any():
            distances = np.abs(columns - np.interp(rows, other_rows, other_columns))[common]
            greatest = max(greatest, float(distances.max()) * COMPARED_WIDTH / base["width"])
    return greatest


def _points(lane: Mapping[str, Any]) -> tuple[Any, Any]:
    """Returns the rows and the columns of a boundary's points, ordered by row."""
    points = np.asarray(sorted(lane["points"], key=lambda point: point[1]), float).reshape(-1, 2)
    return points[:, 1], points[:, 0]


def _lane_names(answer: Mapping[str, Any]) -> set[tuple[int, int]]:
    return {(lane["track_id"], lane["position"]) for lane in answer["lanes"]}


@dataclass(frozen=True)
class Checkout:
    """One side of the comparison: the folder of its source tree."""

    name: str
    folder: Path

    @property
    def environment(self) -> dict[str, str]:
        """The environment variables of its processes."""
        path = os.pathsep.join(str(self.folder / folder) for folder in PACKAGE_FOLDERS)
        return {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


class Worker:
    """A process of a checkout that finds the lanes of frames (compare_worker.py)."""

    def __init__(self, checkout: Checkout, cpu: int) -> None:
        self._checkout = checkout
        self.started = time.monotonic()
        self._process = subprocess.Popen(
            # -P: the modules of tools/ are no business of the checkout's.
            [sys.executable, "-P", str(ROOT / "tools/compare_worker.py"), str(cpu)],
            env=checkout.environment,
            cwd=checkout.folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )

    def lanes(self, frame: Frame, seq: int, **options: object) -> dict[str, Any]:
        """Sends a frame and returns the reply. Raises CompareError if the process died or has another checkout's code.

        `options` are the `detector` of a new camera, and `answer=True` for the lanes.
        """
        assert self._process.stdin is not None  # noqa: S101 - both are pipes
        assert self._process.stdout is not None  # noqa: S101
        image, timestamp = frame
        request = {"size": len(image), "seq": seq, "timestamp": timestamp, **options}
        try:
            self._process.stdin.write(json.dumps(request).encode() + b"\n" + image)
            self._process.stdin.flush()
        except BrokenPipeError:
            pass
        line = self._process.stdout.readline()
        if not line:
            raise CompareError(f"the process of {self._checkout.name} died with exit code {self._process.wait()}")
        reply: dict[str, Any] = json.loads(line)
        if not Path(reply["package"]).is_relative_to(self._checkout.folder):
            raise CompareError(f"{self._checkout.name} imported {reply['package']}, not from {self._checkout.folder}")
        return reply

    def run(self, clips: Sequence[Sequence[Frame]], detector: str, *, answer: bool = False) -> list[dict[str, Any]]:
        """Returns the replies to all frames; every clip has a camera of its own."""
        return [
            self.lanes(frame, seq, answer=answer, **({"detector": detector} if seq == 0 else {}))
            for clip in clips
            for seq, frame in enumerate(clip)
        ]

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.communicate()


def compare_detector(
    checkouts: Mapping[str, Checkout], clips: Sequence[Sequence[Frame]], detector: str, rounds: int, starts: int
) -> dict[str, Any]:
    """Measures both checkouts with one detector. Returns the pairs by quantity, and the differences of the answers."""
    cpu = max(os.sched_getaffinity(0))
    quantities = ("cpu_ms_per_frame", "wall_ms_per_frame", "peak_rss_mb", "first_answer_s", "first_answer_cpu_s")
    measured: dict[str, dict[str, list[float]]] = {key: {name: [] for name in SIDES} for key in quantities}
    with ExitStack() as stack:
        workers = {}
        for name, checkout in checkouts.items():
            workers[name] = Worker(checkout, cpu)
            stack.callback(workers[name].close)
        # The first pass warms up and is not timed: its answers are compared.
        answers = {name: worker.run(clips, detector, answer=True) for name, worker in workers.items()}
        for number in range(rounds):
            for name in _in_turn(number):
                replies = workers[name].run(clips, detector)
                measured["cpu_ms_per_frame"][name].append(1e3 * mean(reply["cpu_s"] for reply in replies))
                measured["wall_ms_per_frame"][name].append(1e3 * mean(reply["wall_s"] for reply in replies))
        for name, worker in workers.items():
            measured["peak_rss_mb"][name].append(worker.lanes(clips[0][0], 0, detector=detector)["peak_rss_mb"])
    for number in range(starts):
        for name in _in_turn(number):
            wall_s, cpu_s = _time_to_first_answer(checkouts[name], cpu, clips[0][0], detector)
            measured["first_answer_s"][name].append(wall_s)
            measured["first_answer_cpu_s"][name].append(cpu_s)
    differences = Differences()
    for old, new in zip(*(answers[name] for name in SIDES), strict=True):
        differences.add(old["answer"], new["answer"])
    pairs = {key: asdict(Pair.of(*(values[name] for name in SIDES))) for key, values in measured.items()}
    return {**pairs, "differences": asdict(differences)}


def _time_to_first_answer(checkout: Checkout, cpu: int, frame: Frame, detector: str) -> tuple[float, float]:
    """Returns the seconds from the start of a fresh process to its first answer, and the CPU time that it took."""
    worker = Worker(checkout, cpu)
    try:
        reply = worker.lanes(frame, 0, detector=detector)
        return reply["answered"] - worker.started, reply["process_cpu_s"]
    finally:
        worker.close()


def _in_turn(number: int) -> Sequence[str]:
    """Returns the names of both sides in the order of a round: each is first in every second round."""
    return SIDES[::-1] if number % 2 else SIDES


def compare_services(
    checkouts: Mapping[str, Checkout], clips: Sequence[Sequence[Frame]], starts: int, folder: Path
) -> dict[str, Any]:
    """Returns the pair `pss_mb`: the memory of a whole service with two worker processes after some frames."""
    images = [image for clip in clips for image, _ in clip][:SERVICE_FRAMES]
    memory: dict[str, list[float]] = {name: [] for name in SIDES}
    for number in range(starts):
        for name in _in_turn(number):
            memory[name].append(_service_pss_mb(checkouts[name], images, folder / f"{name}.log"))
    return {"pss_mb": asdict(Pair.of(*(memory[name] for name in SIDES)))}


def _service_pss_mb(checkout: Checkout, images: Sequence[bytes], log_path: Path) -> float:
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    command = [sys.executable, "-P", "-m", "lanestream.cli", "serve", "--port", str(port), "--provider", "cpu"]
    settings = {"LANESTREAM_PROCESSES": str(SERVICE_PROCESSES), "LANESTREAM_FRAMES_PER_S": "100000"}
    with log_path.open("w") as log:
        process = subprocess.Popen(
            command, env={**checkout.environment, **settings}, cwd=checkout.folder, stdout=log, stderr=log
        )
        try:
            _wait_until_ready(process, url, log_path)
            for image in images:
                httpx.post(f"{url}/v1/detect", content=image, timeout=READY_S).raise_for_status()
            tree = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
            return sum(pss_mb(Path(f"/proc/{each.pid}/smaps_rollup").read_text()) for each in tree)
        finally:
            stop(process)


def pss_mb(smaps_rollup: str) -> float:
    """Returns a process's proportional set size in MB, from its file smaps_rollup: shared pages count in part."""
    (line,) = [line for line in smaps_rollup.splitlines() if line.startswith("Pss:")]
    return int(line.split()[1]) * 1024 / 1e6


def _wait_until_ready(process: subprocess.Popen[bytes], url: str, log_path: Path) -> None:
    end = time.monotonic() + READY_S
    while time.monotonic() < end and process.poll() is None:
        try:
            if httpx.get(f"{url}/readyz").is_success:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    raise CompareError(f"the service did not start; its log ends\n{log_path.read_text()[-2000:]}")


def read_frames(path: Path, count: int) -> list[Frame]:
    """Returns the first `count` frames of a video, encoded as JPEG, or the image files of a folder as they are.

    Raises CompareError if there are none.
    """
    if path.is_dir():
        images = sorted(file for file in path.iterdir() if file.suffix.lower() in (".jpg", ".jpeg", ".png", ".webp"))
        frames = [(file.read_bytes(), seq / DEFAULT_FPS) for seq, file in enumerate(images[:count])]
    else:
        video = cv2.VideoCapture(str(path))
        fps = video.get(cv2.CAP_PROP_FPS) or DEFAULT_FPS
        frames = [(_encode(image), seq / fps) for seq, image in enumerate(islice(_decode(video), count))]
    if not frames:
        raise CompareError(f"{path} is not a video or a folder with images")
    return frames


def _decode(video: cv2.VideoCapture) -> Iterator[Any]:
    while True:
        found, image = video.read()
        if not found:
            return
        yield image


def _encode(image: Any) -> bytes:
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])


@contextmanager
def worktree(revision: str) -> Iterator[Path]:
    """A checkout of `revision` in a temporary folder, removed at the end. Raises CompareError if git fails."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder).resolve() / "base"
        _git("worktree", "add", "--detach", str(path), revision)
        try:
            yield path
        finally:
            _git("worktree", "remove", "--force", str(path))


def _git(*arguments: str) -> str:
    result = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)  # noqa: S607
    if result.returncode:
        raise CompareError(f"git {arguments[0]}: {result.stderr.strip()}")
    return result.stdout.strip()


def table(report: Mapping[str, Any]) -> Iterator[str]:
    """Yields the report as Markdown tables."""
    yield f"{report['frames']} frames, {report['rounds']} rounds, {report['starts']} starts; base {report['base'][:10]}"
    yield ""
    yield "| detector | quantity | base | present | ratio | min | max |"
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    groups = [*report["detectors"].items(), *([("service", report["service"])] if report["service"] else [])]
    for name, group in groups:
        for quantity, pair in group.items():
            if quantity == "differences":
                continue
            ratios = (f"{pair[key]:.3f}" for key in ("ratio", "ratio_min", "ratio_max"))
            cells = (name, quantity, f"{pair['base']:.2f}", f"{pair['present']:.2f}", *ratios)
            yield f"| {' | '.join(cells)} |"
    yield ""
    yield "| detector | frames | other lanes | other columns | largest difference, px at 640 |"
    yield "| --- | --- | --- | --- | --- |"
    for name, group in report["detectors"].items():
        found = Differences(**group["differences"])
        counts = (found.frames, found.frames_with_other_lanes, found.frames_with_other_columns)
        yield f"| {name} | {' | '.join(map(str, counts))} | {found.largest_px_at_640:.3f} |"


def compare(
    revision: str,
    paths: Sequence[Path],
    frames: int,
    rounds: int,
    starts: int,
    service: bool,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Returns the report of the whole comparison; `say` is called with a line on each step. Raises CompareError."""
    try:
        base_revision = _git("rev-parse", "--verify", f"{revision}^{{commit}}")
    except CompareError as error:
        raise CompareError(f"{revision} is not a commit of this repository: give a hash, a tag or a branch") from error
    clips = [read_frames(path, frames) for path in paths]
    with worktree(base_revision) as folder, tempfile.TemporaryDirectory() as logs:
        checkouts = {name: Checkout(name, path) for name, path in zip(SIDES, (folder, ROOT), strict=True)}
        detectors = {}
        for detector in DETECTORS:
            say(f"measuring {detector}")
            detectors[detector] = compare_detector(checkouts, clips, detector, rounds, starts)
        services = None
        if service:
            say("measuring the memory of the services")
            services = compare_services(checkouts, clips, starts, Path(logs))
    return {
        "base": base_revision,
        "frames": sum(map(len, clips)),
        "rounds": rounds,
        "starts": starts,
        "detectors": detectors,
        "service": services,
    }


@click.command()
@click.argument(
    "paths", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path), metavar="VIDEO|FOLDER..."
)
@click.option("--base", required=True, metavar="REVISION", help="The git revision to compare with.")
@click.option("--frames", type=click.IntRange(1), default=100, show_default=True, help="Frames of each clip.")
@click.option("--rounds", type=click.IntRange(1), default=5, show_default=True, help="Timed passes over all frames.")
@click.option("--starts", type=click.IntRange(1), default=5, show_default=True, help="Fresh processes of each side.")
@click.option("--service", is_flag=True, help="Compare the memory of whole services with two worker processes, too.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write the report to this file, too.")
def main(
    paths: tuple[Path, ...], base: str, frames: int, rounds: int, starts: int, service: bool, json_path: Path | None
) -> None:
    """Compare the present tree with the git revision --base on the frames of videos or of folders with images."""
    try:
        report = compare(base, paths, frames, rounds, starts, service, lambda line: click.echo(line, err=True))
    except (CompareError, OSError, httpx.HTTPError) as error:
        raise click.ClickException(str(error)) from error
    if json_path is not None:
        json_path.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    for line in table(report):
        click.echo(line)


if __name__ == "__main__":
    main()
