"""The report of a benchmark: from samples to `bench.json`, and from there to the tables of docs/benchmarks.md.

PYTHONPATH=tools python -m bench.report [out/bench.json]     prints the tables
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from typing import Any, Final

import click
import numpy as np

import lanestream
from bench.in_process import PipelineInfo
from bench.measure import Overload, Results, Sample
from bench.workload import BASELINE, IN_PROCESS, LARGE, LITSERVE, SERVICE, Size, Suite, Workload
from lanestream.host import cpu_affinity, cpu_info

_PACKAGES: Final = (
    *("onnxruntime", "opencv-python-headless", "numpy", "uvicorn", "websockets", "fastapi"),
    *("torch", "litserve", "filterpy", "openvino"),
)
# The headline numbers by their keys.
HEADLINES: Final = {
    "service_over_inprocess": "throughput over the in-process pipeline, 4 sessions",
    "at_64_over_at_4": "throughput at 64 sessions over that at 4",
    "over_baseline": "throughput over the baseline service, 4 sessions",
    "over_litserve": "throughput over LitServe, 4 sessions",
    "median_ms_720p_classifier": "median from frame to reply, classifier, ms",
    "median_ms_720p_regressor": "median from frame to reply, regressor, ms",
    "overload_p95_age_over_median": "p95 frame age at 3 times the load over the median without load",
    "generator_cpu_share": "load generators' share of the processors, maximum",
}
_COLUMNS: Final = ("", "frames", "sessions", "in flight", "frames/s", "p50 ms", "p95", "p99", "CPU ms/frame", "MB")

Round = Mapping[Workload, Sample]


def report(results: Results, suite: Suite, info: PipelineInfo, frames: str) -> dict[str, Any]:
    """Returns the content of `bench.json`; docs/benchmarks.md describes its keys."""
    ratios = {_size_name(size): _throughput_ratios(results, suite, size) for size in suite.sizes}
    overloads = [_overload_row(results, clients) for clients in suite.overload_clients]
    samples = [sample for each in results.rounds for sample in each.values()]
    workloads = dict.fromkeys(workload for each in results.rounds for workload in each)
    return {
        **{key: ratio["median"] for key, ratio in ratios[_size_name(LARGE)].items()},
        "median_ms_720p_classifier": _median_latency_ms(results, LARGE, "candidates"),
        "median_ms_720p_regressor": _median_latency_ms(results, LARGE, "regression"),
        "overload_p95_age_over_median": overloads[-1]["p95_age_over_median"],
        "generator_cpu_share": round(max(sample.generator_share for sample in samples), 4),
        "failed": sum(sample.failed for sample in samples),
        "rounds": suite.rounds,
        "ratios": ratios,
        "workloads": [
            _workload_row(workload, [each[workload] for each in results.rounds if workload in each])
            for workload in workloads
        ],
        "overload": overloads,
        "soak": None if results.soak is None else _soak_row(results.soak, results.memory_before_soak_mb),
        "model": info.model,
        "provider": info.provider,
        "processes": info.processes,
        "threads": info.threads,
        "candidates_per_frame": round(info.patches, 2),
        "frames": frames,
        "machine": _machine(),
        "versions": {
            "lanestream": lanestream.__version__,
            "python": platform.python_version(),
            **dict(_installed_versions()),
        },
    }


def _throughput_ratios(results: Results, suite: Suite, size: Size) -> dict[str, Any]:
    """Returns ratios of throughputs, each with its spread over the rounds in which both runners had settled."""
    few, many = suite.compared_sessions, max(suite.sessions)

    def fps(samples: Round, runner: str, sessions: int = few) -> float:
        wanted = (runner, size, sessions, 2)
        for workload, sample in samples.items():
            if (workload.runner, workload.size, workload.sessions, workload.in_flight) == wanted:
                return sample.fps if sample.settled else 0.0
        return 0.0

    def ratio(numerator: Callable[[Round], float], denominator: Callable[[Round], float]) -> dict[str, float | None]:
        pairs = [(numerator(samples), denominator(samples)) for samples in results.rounds]
        return _spread([upper / lower for upper, lower in pairs if upper > 0.0 and lower > 0.0])

    def service(samples: Round) -> float:
        return fps(samples, SERVICE)

    return {
        "service_over_inprocess": ratio(service, lambda samples: max(fps(samples, name) for name in IN_PROCESS)),
        f"at_{many}_over_at_{few}": ratio(lambda samples: fps(samples, SERVICE, many), service),
        "over_baseline": ratio(service, lambda samples: fps(samples, BASELINE)),
        "over_litserve": ratio(service, lambda samples: fps(samples, LITSERVE)),
    }


def _spread(values: Sequence[float]) -> dict[str, float | None]:
    """Returns the median, minimum and maximum; all None without values, if a runner did not answer or is missing."""
    numbers = (median(values), min(values), max(values)) if values else (None, None, None)
    return {
        key: None if number is None else round(number, 4)
        for key, number in zip(("median", "min", "max"), numbers, strict=True)
    }


def _workload_row(workload: Workload, samples: Sequence[Sample]) -> dict[str, Any]:
    """Returns one workload's numbers: rates are medians over rounds, times are percentiles over all replies."""
    cpu = [sample.cpu_ms_per_frame for sample in samples if sample.cpu_ms_per_frame is not None]
    settled = all(sample.settled for sample in samples)
    times = [ms for sample in samples for ms in sample.milliseconds]
    return {
        "runner": workload.runner,
        "size": _size_name(workload.size),
        "detector": workload.detector,
        "sessions": workload.sessions,
        "in_flight": workload.in_flight,
        "rounds": len(samples),
        "fps": _spread([sample.fps for sample in samples]),
        **_percentiles(times if settled else ()),
        "cpu_ms_per_frame": round(median(cpu), 2) if cpu else None,
        "memory_mb": round(median(sample.memory_mb for sample in samples), 1),
        "generator_cpu_share": round(median(sample.generator_share for sample in samples), 4),
        "replies": len(times),
        "failed": sum(sample.failed for sample in samples),
    }


def _percentiles(times: Sequence[float]) -> dict[str, float | None]:
    keys = ("p50_ms", "p95_ms", "p99_ms")
    if not times:
        return dict.fromkeys(keys)
    return {key: round(float(value), 2) for key, value in zip(keys, np.percentile(times, (50, 95, 99)), strict=True)}


def _median_latency_ms(results: Results, size: Size, detector: str) -> float | None:
    """Returns the median time from frame to reply for one camera that waits for each reply, over all rounds."""
    return _percentiles([ms for samples in results.rounds for ms in _latencies(samples, size, detector)])["p50_ms"]


def _latencies(samples: Round, size: Size, detector: str = "candidates") -> list[float]:
    wanted = (SERVICE, size, 1, detector)
    return [
        ms
        for workload, sample in samples.items()
        if (workload.runner, workload.size, workload.in_flight, workload.detector) == wanted
        for ms in sample.milliseconds
    ]


def _overload_row(results: Results, clients: int) -> dict[str, Any]:
    """Returns the ages of frames at their replies under overload by some clients, and their ratio to the latency."""
    overloads, ratios = [], []
    for samples, all_overloads in zip(results.rounds, results.overloads, strict=True):
        overload = next(each for each in all_overloads if each.clients == clients)
        overloads.append(overload)
        ages, unloaded = overload.sample.milliseconds, _latencies(samples, LARGE)
        if ages and unloaded:
            ratios.append(float(np.percentile(ages, 95)) / median(unloaded))
    ages = [ms for overload in overloads for ms in overload.sample.milliseconds]
    return {
        "clients": clients,
        "pushed_fps": round(median(overload.rate for overload in overloads) * clients, 1),
        "fps": round(median(overload.sample.fps for overload in overloads), 1),
        **{key.replace("ms", "age_ms"): value for key, value in _percentiles(ages).items()},
        "p95_age_over_median": round(median(ratios), 3) if ratios else None,
        "p95_age_over_median_rounds": [round(ratio, 3) for ratio in ratios],
    }


def _soak_row(overload: Overload, memory_before_mb: float) -> dict[str, Any]:
    """Returns whether frames get older over time: the slope of each second's median age, and the ages at both ends."""
    sample = overload.sample
    seconds = ages_by_second(sample)
    medians = [median(ages) for ages in seconds]
    slope = float(np.polyfit(range(len(seconds)), medians, 1)[0]) if len(seconds) > 1 else 0.0
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
        "memory_mb": {"before": round(memory_before_mb, 1), "after": round(sample.memory_mb, 1)},
        "failed": sample.failed,
    }


def ages_by_second(sample: Sample) -> list[list[float]]:
    """Returns the frame ages in milliseconds at the replies of each second that had any."""
    start = min((reply.answered for reply in sample.replies), default=0.0)
    seconds: dict[int, list[float]] = {}
    for reply in sample.replies:
        seconds.setdefault(int(reply.answered - start), []).append(1e3 * (reply.answered - reply.sent))
    return [seconds[second] for second in sorted(seconds)]


def _size_name(size: Size) -> str:
    return f"{size[0]}x{size[1]}"


def _machine() -> dict[str, Any]:
    name = cpu_info().get("model name") or platform.processor()
    return {"processor": name, "processors": cpu_affinity(), "system": platform.platform()}


def _installed_versions() -> Iterator[tuple[str, str]]:
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            yield package, version(package)


def markdown(content: Mapping[str, Any]) -> Iterator[str]:
    """Yields the lines of both tables, and of what was measured where."""
    machine, versions = content["machine"], content["versions"]
    yield (
        f"{machine['processors']} processors ({machine['processor']}), provider {content['provider']},"
        f" {content['model']}, {content['candidates_per_frame']:g} candidates per frame, {content['frames']},"
        f" {content['rounds']} rounds, PyTorch {versions['torch']}, LitServe {versions.get('litserve', '-')}."
    )
    yield ""
    yield from _table(("1280 x 720", "median", "min to max"), (_headline(content, key) for key in HEADLINES))
    yield ""
    yield from _table(_COLUMNS, map(_workload_cells, content["workloads"]))


def _headline(content: Mapping[str, Any], key: str) -> tuple[str, ...]:
    spread = content["ratios"]["1280x720"].get(key)
    interval = "" if spread is None else f"{_number(spread['min'], 2)} to {_number(spread['max'], 2)}"
    return HEADLINES[key], _number(content.get(key), 2), interval


def _workload_cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    name = row["runner"] + (", regressor" if row["detector"] == "regression" else "")
    counts = (row["size"].replace("x", " x "), str(row["sessions"]), str(row["in_flight"]))
    times = (_number(row[key]) for key in ("p50_ms", "p95_ms", "p99_ms", "cpu_ms_per_frame"))
    return (name, *counts, _number(row["fps"]["median"]), *times, f"{row['memory_mb']:.0f}")


def _number(value: float | None, decimals: int = 1) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"


def _table(columns: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> Iterator[str]:
    for row in (columns, ("---",) * len(columns), *rows):
        yield "| " + " | ".join(row) + " |"


@click.command()
@click.argument("path", type=click.Path(path_type=Path), default=Path("out/bench.json"))
def main(path: Path) -> None:
    """Print the tables of docs/benchmarks.md as Markdown, from PATH."""
    try:
        lines = list(markdown(json.loads(path.read_text(encoding="utf-8"))))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise click.ClickException(f"{path} was not written by `make bench`: {error}") from error
    for line in lines:
        click.echo(line)


if __name__ == "__main__":
    main()
