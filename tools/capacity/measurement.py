"""Measures real nodes under the loads that the simulation is checked with. Each run is kept, so that it can go on."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, Final, Literal

import redis
from bench.frames import load_clips
from bench.workload import LARGE

from capacity.calibration import Calibration, calibrate
from capacity.cameras import CameraProcess, CameraReport, CameraRequest
from capacity.load import Load, outcome
from capacity.nodes import Node, NodeSetup, running_nodes, running_redis
from capacity.other_programs import others, precedence

Engine = Literal["real", "waiting"]

# A node with the real engine has this much of a processor: three of them, and the cameras, fit on two.
CORES: Final = 0.4
_CALIBRATED_FRAMES: Final = 100
_IMAGES: Final = 24
_WARM_UP_S: Final = 3.0
# From the first frame to the loss of a node, and from there to the end.
LOSS_AFTER_S: Final = 5.0
_AFTER_LOSS_S: Final = 8.0


@dataclass(frozen=True)
class Case:
    """A number of nodes, their engine, and a load of `load.cameras` cameras on each. With `loss` one node is killed."""

    engine: Engine
    nodes: int
    load: Load
    loss: bool = False

    @property
    def name(self) -> str:
        """A name for files and tables."""
        rate = "max" if self.load.fps is None else f"{self.load.fps:g}"
        return f"{self.engine}-{self.nodes}-{self.load.mode}-{self.load.cameras}x{rate}{'-loss' if self.loss else ''}"


def cases() -> list[Case]:
    """Returns all cases: from half of what a node can do to more than it can, and the loss of a node."""
    loads: dict[Engine, tuple[Load, ...]] = {
        "real": (Load(2, 4.0), Load(3, 4.0), Load(6, 4.0), Load(4, None, "all", in_flight=2)),
        "waiting": (Load(2, 10.0), Load(3, 10.0), Load(5, 10.0)),
    }
    found = [Case(engine, nodes, load) for nodes in (1, 2, 3) for engine, each in loads.items() for load in each]
    return [*found, *(Case("waiting", nodes, Load(2, 5.0), loss=True) for nodes in (2, 3))]


class Measurement:
    """The measurement in the folder `out`."""

    def __init__(self, out: Path, seconds: float, say: Callable[[str], None]) -> None:
        self._out, self._seconds, self._say = out, seconds, say
        self._frames = out / "frames"
        self._images: list[bytes] = []

    def run(self, repeats: int, selected: Sequence[Case], until: float | None) -> bool:
        """Measures what is missing of the `selected` cases. Returns False if the time `until` (monotonic) came first.

        Raises CpuGroupError, RuntimeError and OSError if that is not possible here.
        """
        with precedence():
            return self._run(repeats, selected, until)

    def _run(self, repeats: int, selected: Sequence[Case], until: float | None) -> bool:
        (self._out / "runs").mkdir(parents=True, exist_ok=True)
        self._images = [path.read_bytes() for path in sorted(load_frames(self._frames).glob("*.jpg"))]
        for engine in sorted({case.engine for case in selected}):
            if not self.calibration_path(engine).exists():
                self._calibrate(engine)
        # The repeats of a case are not measured in a row: what disturbs one should not disturb all.
        missing = [
            (case, repeat)
            for repeat in range(repeats)
            for case in selected
            if not self._run_path(case, repeat).exists()
        ]
        for (engine, nodes, _), group in groupby(missing, lambda run: (run[0].engine, run[0].nodes, run[0].loss)):
            if not self._run_group(engine, nodes, list(group), until):
                return False
        return True

    def calibration_path(self, engine: Engine) -> Path:
        """The file with the service times of an engine."""
        return self._out / f"calibration-{engine}.json"

    def _run_path(self, case: Case, repeat: int) -> Path:
        return self._out / "runs" / f"{case.name}-{repeat}.json"

    def _setup(self, engine: Engine) -> NodeSetup:
        if engine == "real":
            return NodeSetup(cores=CORES)
        times = self._out / "waiting-times.json"
        content = Calibration.read(self.calibration_path("real"))
        times.write_text(json.dumps([each.worker_s for each in content.frames]), encoding="utf-8")
        return NodeSetup(waiting_times=times)

    def _calibrate(self, engine: Engine) -> None:
        def measure(setup: NodeSetup, count: int) -> Calibration:
            with running_redis(self._out) as url, running_nodes(1, setup, url, self._out) as nodes:
                return calibrate(nodes[0], self._images, count, waits=engine == "waiting")

        self._say(f"calibrating one node, {engine}")
        setup = self._setup(engine)
        result = measure(setup, _CALIBRATED_FRAMES)
        if setup.cores is not None:
            result = result.with_rest_of(measure(NodeSetup(), _CALIBRATED_FRAMES // 2))
        result.write(self.calibration_path(engine))

    def _run_group(self, engine: Engine, nodes: int, runs: list[tuple[Case, int]], until: float | None) -> bool:
        """Measures cases on the same nodes. A lost node is not replaced, so after a loss they start again."""
        with ExitStack() as stack:
            running: tuple[str, list[Node]] | None = None
            for case, repeat in runs:
                if until is not None and time.monotonic() + 2.0 * self._seconds > until:
                    return False
                if running is None or case.loss:
                    stack.close()
                    url = stack.enter_context(running_redis(self._out))
                    running = url, stack.enter_context(running_nodes(nodes, self._setup(engine), url, self._out))
                with others() as found:
                    result = self._measure(case, repeat, *running)
                result["others_share"] = found.share
                self._run_path(case, repeat).write_text(json.dumps(result) + "\n", encoding="utf-8")
                self._say(f"{case.name:28} {repeat}  {_summary(result)}")
        return True

    def _measure(self, case: Case, repeat: int, redis_url: str, nodes: list[Node]) -> dict[str, Any]:
        seconds = LOSS_AFTER_S + _AFTER_LOSS_S if case.loss else _WARM_UP_S + self._seconds
        urls = [[node.url for node in nodes[first:] + nodes[:first]] for first in range(len(nodes))]
        cameras = case.load.cameras * case.nodes
        request = CameraRequest(
            Load(cameras, case.load.fps, case.load.mode, case.load.in_flight),
            [urls[camera % len(urls)] for camera in range(cameras)],
            seconds,
            repeat,
            self._frames,
        )
        before = _RedisCounts.read(redis_url)
        cpu = [node.cpu_s() for node in nodes]
        process = CameraProcess(request)
        try:
            lost_at = None
            if case.loss:
                time.sleep(LOSS_AFTER_S + 2.0)
                lost_at = time.monotonic()
                nodes[0].kill()
            report = process.report()
        finally:
            process.kill()
        if lost_at is not None:
            return {"case": case.name, "repeat": repeat, "resumed_s": resume_times(report, lost_at, len(nodes))}
        used = [
            (after[0] - then[0], after[1] - then[1])
            for then, after in zip(cpu, (node.cpu_s() for node in nodes), strict=True)
        ]
        answered = sum(frame.answered is not None for frame in report.frames)
        start = report.began + _WARM_UP_S
        counts = _RedisCounts.read(redis_url)
        return {
            "case": case.name,
            "repeat": repeat,
            **asdict(outcome(report.frames, start, start + self._seconds)),
            "loop_ms_per_frame": 1e3 * sum(loop for loop, _ in used) / answered,
            "worker_ms_per_frame": 1e3 * sum(worker for _, worker in used) / answered,
            "saves_per_stream_s": (counts.saves - before.saves) / seconds / cameras,
            "redis_us_per_save": (counts.save_us - before.save_us) / max(1, counts.saves - before.saves),
            "redis_bytes_per_save": (counts.bytes_in - before.bytes_in) / max(1, counts.saves - before.saves),
        }


def load_frames(folder: Path) -> Path:
    """Returns `folder`, with the JPEG files of a rendered drive, which it writes if there are none."""
    folder.mkdir(parents=True, exist_ok=True)
    if not any(folder.glob("*.jpg")):
        for number, image in enumerate(load_clips((LARGE,), _IMAGES)[LARGE]):
            (folder / f"{number:03}.jpg").write_bytes(image)
    return folder


def resume_times(report: CameraReport, lost_at: float, nodes: int) -> list[float]:
    """Returns, for each camera of the first of the `nodes`, the seconds from its loss to the next answer.

    Raises RuntimeError if a camera got no further answer.
    """
    cameras = {frame.camera for frame in report.frames if frame.camera % nodes == 0}
    found = []
    for camera in sorted(cameras):
        answers = [each.answered for each in report.frames if each.camera == camera and each.answered is not None]
        later = [answer for answer in answers if answer > lost_at]
        if not later:
            raise RuntimeError(f"camera {camera} did not resume after the loss of its node")
        found.append(min(later) - lost_at)
    return found


@dataclass(frozen=True)
class _RedisCounts:
    """What Redis has counted: scripts run, the microseconds they took, and the bytes received."""

    saves: int
    save_us: float
    bytes_in: int

    @classmethod
    def read(cls, url: str) -> _RedisCounts:
        with redis.Redis.from_url(url) as client:
            commands = client.info("commandstats").get("cmdstat_evalsha", {"calls": 0, "usec": 0})
            return cls(commands["calls"], commands["usec"], client.info("stats")["total_net_input_bytes"])


def _summary(result: dict[str, Any]) -> str:
    if "resumed_s" in result:
        return "resumed after " + " ".join(f"{each:.3f}" for each in result["resumed_s"]) + " s"
    return (
        f"{result['answered_per_s']:6.1f} frames/s, {result['dropped_share']:.0%} dropped,"
        f" p50 {result['p50_ms']:.0f} ms, p95 {result['p95_ms']:.0f} ms,"
        f" processor {result['loop_ms_per_frame']:.1f} + {result['worker_ms_per_frame']:.1f} ms per frame,"
        f" {result['others_share']:.0%} used by other programs"
    )


def read_runs(out: Path) -> Iterator[dict[str, Any]]:
    """Yields the results of all runs in the folder `out`."""
    for path in sorted((out / "runs").glob("*.json")):
        yield json.loads(path.read_text(encoding="utf-8"))
