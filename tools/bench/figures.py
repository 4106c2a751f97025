"""From samples to `bench.json`: medians over rounds, and ratios of what was measured in the same round."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np

from bench.inprocess import Hello
from bench.measuring import Sample
from bench.plan import LARGE, LITSERVE, LOOP, NAIVE, PIPELINE, POOL, SERVICE, Cell, Plan, Size
from bench.running import Overload, Results, compared

_PACKAGES: Final = (
    *("lanestream", "onnxruntime", "opencv-python-headless", "numpy", "uvicorn", "websockets", "fastapi"),
    *("torch", "litserve", "filterpy", "openvino"),
)
Round = dict[Cell, Sample]


def figures(results: Results, plan: Plan, hello: Hello, frames: str) -> dict[str, Any]:
    """Everything that `bench.json` holds; docs/benchmarks.md tells the keys."""
    ratios = {_name(size): _ratios(results, plan, size) for size in plan.sizes}
    overloads = [_overloads(results, clients) for clients in plan.overload_clients]
    shares = [sample.generator_share for cells in results.cells for sample in cells.values()]
    return {
        **{key: ratio["median"] for key, ratio in ratios[_name(LARGE)].items()},
        "median_ms_720p_classifier": _alone(results, LARGE, "candidates"),
        "median_ms_720p_regressor": _alone(results, LARGE, "regression"),
        "overload_p95_age_over_median": overloads[-1]["p95_age_over_median"],
        "generator_cpu_share": round(max(shares), 4),
        "failed": sum(sample.failed for cells in results.cells for sample in cells.values()),
        "rounds": plan.rounds,
        "ratios": ratios,
        "cells": [_cell(cell, [each[cell] for each in results.cells if cell in each]) for cell in _all_cells(results)],
        "overload": overloads,
        "soak": None if results.soak is None else _soak(results.soak, results.memory_before_soak_mb),
        "model": hello.model,
        "provider": hello.provider,
        "processes": hello.processes,
        "threads": hello.threads,
        "candidates_per_frame": round(hello.patches, 2),
        "frames": frames,
        "machine": machine(),
        "versions": {"python": platform.python_version(), **dict(_versions())},
    }


def _versions() -> Iterator[tuple[str, str]]:
    """The packages that are there; a runtime may be missing."""
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            yield package, version(package)


def machine() -> dict[str, Any]:
    """The processors that were there, and what they are called."""
    names = [line for line in _lines(Path("/proc/cpuinfo")) if line.startswith("model name")]
    name = names[0].partition(":")[2].strip() if names else platform.processor()
    return {"processor": name, "processors": len(os.sched_getaffinity(0)), "system": platform.platform()}


def _ratios(results: Results, plan: Plan, size: Size) -> dict[str, Any]:
    """Ratios of throughputs, each with its median, least and most over the rounds in which both had settled."""
    few, many = compared(plan), max(plan.sessions)

    def rate(cells: Round, name: str, sessions: int = few) -> float:
        return next(
            sample.fps if sample.settled else 0.0
            for cell, sample in cells.items()
            if (cell.contestant, cell.size, cell.sessions, cell.in_flight) == (name, size, sessions, 2)
        )

    def ratio(upper: Callable[[Round], float], lower: Callable[[Round], float]) -> dict[str, float | None]:
        pairs = [(upper(cells), lower(cells)) for cells in results.cells]
        return _spread([high / low for high, low in pairs if high > 0.0 and low > 0.0])

    def service(cells: Round) -> float:
        return rate(cells, SERVICE)

    def in_process(cells: Round) -> float:
        return max(rate(cells, name) for name in (PIPELINE, LOOP, POOL))

    return {
        "service_over_inprocess": ratio(service, in_process),
        f"at_{many}_over_at_{few}": ratio(lambda cells: rate(cells, SERVICE, many), service),
        "over_naive": ratio(service, lambda cells: rate(cells, NAIVE)),
        "over_litserve": ratio(service, lambda cells: rate(cells, LITSERVE)),
    }


def _spread(values: Sequence[float]) -> dict[str, float | None]:
    """The median and the ends; None where nothing was measured, because nothing was answered."""
    ends = (median(values), min(values), max(values)) if values else (None, None, None)
    return {
        key: None if value is None else round(value, 4)
        for key, value in zip(("median", "least", "most"), ends, strict=True)
    }


def _all_cells(results: Results) -> Iterable[Cell]:
    return dict.fromkeys(cell for cells in results.cells for cell in cells)


def _cell(cell: Cell, samples: Sequence[Sample]) -> dict[str, Any]:
    """One row: rates are medians over rounds, times are percentiles of all answers of all rounds."""
    used = [sample.processor_ms_per_frame for sample in samples if sample.processor_ms_per_frame is not None]
    settled = all(sample.settled for sample in samples)
    times = [ms for sample in samples for ms in sample.milliseconds]
    return {
        "contestant": cell.contestant,
        "size": _name(cell.size),
        "detector": cell.detector,
        "sessions": cell.sessions,
        "in_flight": cell.in_flight,
        "rounds": len(samples),
        "fps": _spread([sample.fps for sample in samples]),
        **(_percentiles(times) if settled else dict.fromkeys(("p50_ms", "p95_ms", "p99_ms"))),
        "cpu_ms_per_frame": round(median(used), 2) if used else None,
        "memory_mb": round(median(sample.memory_mb for sample in samples), 1),
        "generator_cpu_share": round(median(sample.generator_share for sample in samples), 4),
        "answers": len(times),
        "failed": sum(sample.failed for sample in samples),
    }


def _percentiles(times: Sequence[float]) -> dict[str, float | None]:
    keys = ("p50_ms", "p95_ms", "p99_ms")
    if not times:
        return dict.fromkeys(keys)
    return {key: round(float(value), 2) for key, value in zip(keys, np.percentile(times, (50, 95, 99)), strict=True)}


def _alone(results: Results, size: Size, detector: str) -> float | None:
    """The median from frame to reply of one camera of the service that waits for each answer, of all rounds."""
    return _percentiles([ms for cells in results.cells for ms in _unloaded(cells, size, detector)])["p50_ms"]


def _unloaded(cells: Round, size: Size, detector: str = "candidates") -> list[float]:
    return [
        ms
        for cell, sample in cells.items()
        if (cell.contestant, cell.size, cell.in_flight, cell.detector) == (SERVICE, size, 1, detector)
        for ms in sample.milliseconds
    ]


def _overloads(results: Results, clients: int) -> dict[str, Any]:
    """So many clients that push too much: how old a frame is when its answer comes, against the unloaded median."""
    samples, ratios = [], []
    for cells, overloads in zip(results.cells, results.overloads, strict=True):
        overload = next(each for each in overloads if each.clients == clients)
        samples.append(overload)
        ages, unloaded = overload.sample.milliseconds, _unloaded(cells, LARGE)
        if ages and unloaded:
            ratios.append(float(np.percentile(ages, 95)) / median(unloaded))
    ages = [ms for overload in samples for ms in overload.sample.milliseconds]
    return {
        "clients": clients,
        "pushed_fps": round(median(overload.rate for overload in samples) * clients, 1),
        "fps": round(median(overload.sample.fps for overload in samples), 1),
        **{key.replace("ms", "age_ms"): value for key, value in _percentiles(ages).items()},
        "p95_age_over_median": round(median(ratios), 3) if ratios else None,
        "p95_age_over_median_rounds": [round(ratio, 3) for ratio in ratios],
    }


def _soak(overload: Overload, memory_before: float) -> dict[str, Any]:
    """Whether frames get older over time: the slope through the medians of each second, and both ends."""
    sample = overload.sample
    seconds = by_second(sample)
    slope = (
        float(np.polyfit(range(len(seconds)), [median(ages) for ages in seconds], 1)[0]) if len(seconds) > 1 else 0.0
    )
    fifth = max(1, len(seconds) // 5)
    first, last = ([age for ages in part for age in ages] for part in (seconds[:fifth], seconds[-fifth:]))
    return {
        "minutes": round(sample.seconds / 60.0, 3),
        "clients": overload.clients,
        "pushed_fps": round(overload.rate * overload.clients, 1),
        "fps": round(sample.fps, 1),
        "slope_ms_per_minute": round(60.0 * slope, 3),
        "first_fifth": _percentiles(first),
        "last_fifth": _percentiles(last),
        "p95_age_ms_by_second": [round(float(np.percentile(ages, 95)), 1) for ages in seconds],
        "memory_mb": {"before": round(memory_before, 1), "after": round(sample.memory_mb, 1)},
        "failed": sample.failed,
    }


def by_second(sample: Sample) -> list[list[float]]:
    """The ages of the answers of each second in which there were any, in milliseconds."""
    start = min((answer.answered for answer in sample.answers), default=0.0)
    seconds: dict[int, list[float]] = {}
    for answer in sample.answers:
        seconds.setdefault(int(answer.answered - start), []).append(1e3 * (answer.answered - answer.sent))
    return [seconds[second] for second in sorted(seconds)]


def _name(size: Size) -> str:
    return f"{size[0]}x{size[1]}"


def _lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8").splitlines() if path.exists() else []
