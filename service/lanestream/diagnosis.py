"""What networks run on here: the machine, what is installed, and the networks themselves, loaded and timed."""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from lanestream import __version__, machine
from lanestream.engine import SHIPPED_MODEL, resolve_regressor
from lanestream.errors import LanestreamError
from lanestream.inference import LoadedModel, RegressorInfo, load_model
from lanestream.inference.providers import NAMES, offered
from lanestream.runtime import Provider
from lanestream.settings import Settings

_PACKAGES: Final = ("onnxruntime", "onnxruntime-gpu", "openvino", "numpy", "opencv-python-headless")
# Batch sizes that are timed where they are buckets, so many times each.
_TIMED: Final = (1, 2, 4, 8, 12, 16, 32, 64)
_ROUNDS: Final = 9


@dataclass(frozen=True)
class NetworkReport:
    """A loaded network: what its file is, what runs it and why, and how long it takes.

    It `fell_back` where a better provider is installed and can't be used. `nodes` counts the graph's nodes by what
    runs them. `run_ms` are median milliseconds of a run by batch size.
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
    """Everything that was found; `problem` is one line, None where nothing is wrong.

    `software` is what is installed with its version. `installed` are the providers that it has built in, which is not
    to say that they work: what `networks` got is.
    """

    software: Mapping[str, str]
    cpu: machine.Cpu
    gpu: machine.Gpu
    installed: tuple[str, ...]
    asked: Provider
    networks: tuple[NetworkReport, ...]
    problem: str | None


def diagnose(settings: Settings, required: Provider | None = None) -> Diagnosis:
    """Loads the networks that a service with these `settings` would run, and times them.

    Where a provider is `required` and the settings leave the choice, that one is asked for; it is a problem where a
    network runs on another one, and so is a network that can't be loaded.
    """
    asked = required if required and settings.provider == "auto" else settings.provider
    networks: list[NetworkReport] = []
    problem = None
    try:
        networks.extend(_networks(settings, asked))
    except LanestreamError as error:
        problem = str(error)
    others = [each for each in networks if required not in (None, "auto", each.provider)]
    if others and problem is None:
        problem = f"{others[0].name} runs on {others[0].provider}, not on {required}: {others[0].reason}"
    return Diagnosis(_software(), machine.cpu(), machine.gpu(), _installed(), asked, tuple(networks), problem)


def _networks(settings: Settings, provider: Provider) -> Iterator[NetworkReport]:
    network, report = _examined(settings.model or SHIPPED_MODEL, provider, settings)
    yield report
    regressor = resolve_regressor(settings.regressor)
    if regressor is not None and not isinstance(network.info, RegressorInfo):
        yield _examined(regressor, provider, settings)[1]


def _examined(path: Path, provider: Provider, settings: Settings) -> tuple[LoadedModel, NetworkReport]:
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
        run_ms={batch: _median_ms(network, batch) for batch in _TIMED if batch in network.buckets},
    )
    return network, report


def _median_ms(network: LoadedModel, batch: int) -> float:
    inputs = network.blank(batch)
    taken = []
    for _ in range(_ROUNDS):
        started = time.perf_counter()
        network.run(inputs)
        taken.append(1e3 * (time.perf_counter() - started))
    return statistics.median(taken)


def _software() -> Mapping[str, str]:
    found = {"lanestream": __version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def _installed() -> tuple[str, ...]:
    offer = offered()
    names = [name for name, known in NAMES.items() if known in offer.onnxruntime]
    return (*names, *(["openvino"] if offer.openvino else []))
