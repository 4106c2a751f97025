"""What `doctor` reports: the networks, loaded and timed, and what they run on, as tables or as JSON."""

from __future__ import annotations

import json
import platform
import statistics
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import click
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from lanestream import __version__
from lanestream.engine import resolve_model, resolve_regressor
from lanestream.errors import LanestreamError
from lanestream.gpu import Gpu, gpu
from lanestream.host import Cpu, cpu
from lanestream.inference.loaded_model import LoadedModel
from lanestream.inference.loading import load_model
from lanestream.inference.model_info import RegressorInfo
from lanestream.inference.providers import AUTO, PROVIDERS, Installed
from lanestream.packages import installed_versions, owner_versions, package_conflicts
from lanestream.settings import Settings
from lanestream.suggestions import Findings, Suggestion, suggestions
from lanestream.workers.process_pool import processes_in_memory

_PACKAGES: Final = ("openvino", "numpy")
# The batch sizes to time, as far as they are among a model's batch sizes.
_BATCH_SIZES: Final = (1, 2, 4, 8, 12, 16, 32, 64)
_RUNS_PER_BATCH_SIZE: Final = 9
# Without a terminal, lines are this wide, so that paths and reasons are not broken.
_PIPE_WIDTH: Final = 200


@dataclass(frozen=True)
class NetworkReport:
    """A loaded network: its file, the provider that runs it and why, and its speed.

    `fell_back` is true if a better provider is installed but can't be used. `nodes` counts the graph's nodes by what
    runs them. `run_ms` is the median time of one run in milliseconds, by batch size.
    """

    file: str
    sha256: str
    name: str
    kind: str
    precision: str
    provider: str
    reason: str
    fell_back: bool
    threads: int
    nodes: Mapping[str, int]
    load_ms: float
    warm_up_ms: float
    run_ms: Mapping[int, float]


@dataclass(frozen=True)
class Diagnosis:
    """Everything that `doctor` reports. `problem` is one line, or None if nothing is wrong.

    `software` maps installed packages to their versions; `conflicts` are lines about those that overwrite each other.
    `installed` lists the providers that are built in; whether one works shows in `networks`. `asked` is the provider
    that the networks were asked to run on. `suggestions` say what would be faster.
    """

    software: Mapping[str, str]
    conflicts: tuple[str, ...]
    cpu: Cpu
    gpu: Gpu
    installed: tuple[str, ...]
    asked: str
    networks: tuple[NetworkReport, ...]
    suggestions: tuple[Suggestion, ...]
    problem: str | None


def diagnose(settings: Settings, required: str | None = None) -> Diagnosis:
    """Loads and times the networks that a service with these `settings` would run.

    If the settings leave the provider to `auto`, the networks are asked to run on the `required` one. A network that
    can't be loaded or that runs on another provider than the required one is a problem.
    """
    provider = required if required and settings.provider == AUTO else settings.provider
    networks: list[NetworkReport] = []
    problem = None
    try:
        networks.extend(_load_networks(settings, provider))
    except LanestreamError as error:
        problem = str(error)
    elsewhere = [network for network in networks if required not in (None, AUTO, network.provider)]
    if elsewhere and problem is None:
        network = elsewhere[0]
        problem = f"{network.name} runs on {network.provider}, not on {required}: {network.reason}"
    findings = Findings(
        cpu=cpu(),
        gpu=gpu(),
        installed=_installed_providers(),
        asked=provider,
        runs_on=tuple(network.provider for network in networks),
        precisions=tuple(network.precision for network in networks),
        skipped=next((network.reason for network in networks if network.fell_back), None),
        worker_limit=processes_in_memory(),
    )
    return Diagnosis(
        software=_software(),
        conflicts=package_conflicts(),
        cpu=findings.cpu,
        gpu=findings.gpu,
        installed=findings.installed,
        asked=provider,
        networks=tuple(networks),
        suggestions=suggestions(findings),
        problem=problem,
    )


def print_diagnosis(diagnosis: Diagnosis, *, as_json: bool) -> None:
    """Prints tables, or one JSON document."""
    if as_json:
        click.echo(json.dumps(asdict(diagnosis), indent=2))
        return
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = _PIPE_WIDTH
    for table in diagnosis_tables(diagnosis):
        console.print(table)
        console.print()


def diagnosis_tables(diagnosis: Diagnosis) -> Iterator[Table]:
    """Yields the diagnosis as tables for a terminal."""
    software = ", ".join(f"{name} {version}" for name, version in diagnosis.software.items())
    installed = f"{', '.join(diagnosis.installed)}; requested: {diagnosis.asked}"
    conflicts = [("conflict", conflict) for conflict in diagnosis.conflicts]
    machine = [
        ("software", software),
        *conflicts,
        *_cpu_rows(diagnosis.cpu),
        *_gpu_rows(diagnosis.gpu),
        ("providers", installed),
    ]
    yield _table("machine", machine)
    for network in diagnosis.networks:
        yield _table(network.kind, _network_rows(network))
        yield _run_times(network)
    if diagnosis.suggestions:
        yield _table("suggestions", [(each.topic.replace("_", " "), each.text) for each in diagnosis.suggestions])


def _load_networks(settings: Settings, provider: str) -> Iterator[NetworkReport]:
    network, report = _load_network(resolve_model(settings.model), provider, settings)
    yield report
    regressor = resolve_regressor(settings.regressor)
    if regressor is not None and not isinstance(network.info, RegressorInfo):
        yield _load_network(regressor, provider, settings)[1]


def _load_network(path: Path, provider: str, settings: Settings) -> tuple[LoadedModel, NetworkReport]:
    started = time.perf_counter()
    network = load_model(path, provider, settings.runtime_options)
    loaded = time.perf_counter()
    network.warm_up()
    warm = time.perf_counter()
    placement = network.placement
    report = NetworkReport(
        file=str(path),
        sha256=network.sha256,
        name=network.name,
        kind=network.info.kind,
        precision=network.info.precision,
        provider=placement.provider,
        reason=placement.reason,
        fell_back=placement.fell_back,
        threads=placement.threads,
        nodes=placement.nodes,
        load_ms=1e3 * (loaded - started),
        warm_up_ms=1e3 * (warm - loaded),
        run_ms={size: _median_run_ms(network, size) for size in _BATCH_SIZES if size in placement.batch_sizes},
    )
    return network, report


def _median_run_ms(network: LoadedModel, batch_size: int) -> float:
    inputs = network.blank(batch_size)
    times = []
    for _ in range(_RUNS_PER_BATCH_SIZE):
        started = time.perf_counter()
        network.run(inputs)
        times.append(1e3 * (time.perf_counter() - started))
    return statistics.median(times)


def _software() -> Mapping[str, str]:
    versions = {"lanestream": __version__, "python": platform.python_version()}
    return {**versions, **owner_versions("onnxruntime"), **installed_versions(_PACKAGES), **owner_versions("cv2")}


def _installed_providers() -> tuple[str, ...]:
    installed = Installed.here()
    return tuple(spec.name for spec in PROVIDERS if spec.is_installed(installed))


def _cpu_rows(cpu: Cpu) -> list[tuple[str, str]]:
    quota = "no quota" if cpu.quota is None else f"a quota of {cpu.quota:g}"
    return [
        ("CPU", cpu.name),
        ("instructions", " ".join(cpu.flags) or "none that speed up networks"),
        ("processors", f"{cpu.used}: {cpu.affinity} by affinity, {quota}"),
    ]


def _gpu_rows(gpu: Gpu) -> list[tuple[str, str]]:
    supported = f", supports CUDA {gpu.driver_cuda}" if gpu.driver_cuda else ""
    built_for = f", onnxruntime is built for {gpu.onnxruntime_cuda}" if gpu.onnxruntime_cuda else ""
    return [
        ("GPU", "; ".join(gpu.devices) or "none"),
        ("driver", (gpu.driver or "none") + supported),
        ("CUDA", (gpu.cuda or "none") + built_for),
        ("cuDNN", gpu.cudnn or "none"),
        ("TensorRT", gpu.tensorrt or "none"),
    ]


def _network_rows(network: NetworkReport) -> list[tuple[str, str]]:
    return [
        ("model", f"{network.name}, {network.precision}"),
        ("file", network.file),
        ("sha256", network.sha256),
        ("provider", f"{network.provider}: {network.reason}"),
        ("nodes", ", ".join(f"{count} {runner}" for runner, count in network.nodes.items())),
        ("threads", str(network.threads)),
        ("start", f"{network.load_ms:.0f} ms to load, {network.warm_up_ms:.0f} ms to warm up"),
    ]


def _table(title: str, rows: list[tuple[str, str]]) -> Table:
    table = Table(title, "", show_edge=False, box=box.SIMPLE_HEAD, padding=(0, 2, 0, 0))
    for name, value in rows:
        # Text, because rich would take brackets in a path for markup.
        table.add_row(Text(name, style="bold"), Text(value))
    return table


def _run_times(network: NetworkReport) -> Table:
    table = Table("batch size", "median ms per run", "ms per input", box=box.SIMPLE_HEAD, show_edge=False)
    for batch_size, milliseconds in network.run_ms.items():
        table.add_row(str(batch_size), f"{milliseconds:.2f}", f"{milliseconds / batch_size:.3f}")
    return table
