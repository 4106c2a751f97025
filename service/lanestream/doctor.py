"""The command `doctor`: what networks run on here, for people and as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import click
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from lanestream.diagnosis import Diagnosis, NetworkReport, diagnose
from lanestream.machine import Cpu, Gpu
from lanestream.runtime import PROVIDERS, Provider
from lanestream.settings import load_settings

# Paths and reasons are not to be broken in a pipe.
_WIDTH_OF_PIPES: Final = 200


@click.command()
@click.option(
    "--require", "required", type=click.Choice(PROVIDERS[1:]), help="Fail unless the networks run on this one."
)
@click.option("--provider", type=click.Choice(PROVIDERS), help="Where they are asked to run  [default: auto]")
@click.option("--model", type=click.Path(path_type=Path), help="ONNX file of the network  [default: the shipped one]")
@click.option(
    "--regressor",
    type=click.Path(path_type=Path),
    metavar="FILE|none",
    help="ONNX file of the second network, or none  [default: the shipped one]",
)
@click.option("--config", type=click.Path(path_type=Path), help="TOML file of settings, as for `serve`.")
@click.option("--json", "as_json", is_flag=True, help="Write one JSON document.")
@click.pass_context
def doctor(context: click.Context, /, required: Provider | None, as_json: bool, **given: Any) -> None:
    """Tell what networks run on here, and how fast; the settings of a service count here, too."""
    diagnosis = diagnose(load_settings(**given), required)
    if as_json:
        click.echo(json.dumps(asdict(diagnosis), indent=2))
    else:
        console = Console(highlight=False)
        if not console.is_terminal:
            console.width = _WIDTH_OF_PIPES
        for table in tables(diagnosis):
            console.print(table)
            console.print()
    if diagnosis.problem is not None:
        click.echo(f"error: {diagnosis.problem}", err=True)
        context.exit(1)


def tables(diagnosis: Diagnosis) -> Iterator[Table]:
    """The diagnosis, for people."""
    software = ", ".join(f"{name} {version}" for name, version in diagnosis.software.items())
    installed = f"{', '.join(diagnosis.installed)}; asked for: {diagnosis.asked}"
    machine = [("software", software), *_cpu(diagnosis.cpu), *_gpu(diagnosis.gpu), ("providers", installed)]
    yield _table("machine", machine)
    for network in diagnosis.networks:
        yield _table(network.kind, _network(network))
        yield _times(network)


def _cpu(cpu: Cpu) -> list[tuple[str, str]]:
    quota = "no quota" if cpu.quota is None else f"a quota of {cpu.quota:g}"
    return [
        ("CPU", cpu.name),
        ("instructions", " ".join(cpu.flags) or "none that matter"),
        ("processors", f"{cpu.used}: {cpu.affinity} by affinity, {quota}"),
    ]


def _gpu(gpu: Gpu) -> list[tuple[str, str]]:
    able = f", good for CUDA {gpu.driver_cuda}" if gpu.driver_cuda else ""
    built = f", onnxruntime is built for {gpu.onnxruntime_cuda}" if gpu.onnxruntime_cuda else ""
    return [
        ("GPU", "; ".join(gpu.devices) or "none"),
        ("driver", (gpu.driver or "none") + able),
        ("CUDA", (gpu.cuda or "none") + built),
        ("cuDNN", gpu.cudnn or "none"),
        ("TensorRT", gpu.tensorrt or "none"),
    ]


def _network(network: NetworkReport) -> list[tuple[str, str]]:
    return [
        ("model", f"{network.name}, {network.precision}"),
        ("file", network.file),
        ("sha256", network.sha256),
        ("provider", f"{network.provider}: {network.reason}"),
        ("nodes", ", ".join(f"{count} {where}" for where, count in network.nodes.items())),
        ("threads", str(network.threads)),
        ("ready after", f"{network.load_ms:.0f} ms to load, {network.warm_up_ms:.0f} ms to warm up"),
    ]


def _table(title: str, rows: list[tuple[str, str]]) -> Table:
    table = Table(title, "", show_edge=False, box=box.SIMPLE_HEAD, padding=(0, 2, 0, 0))
    for name, told in rows:
        # Not markup: brackets in a path are brackets.
        table.add_row(Text(name, style="bold"), Text(told))
    return table


def _times(network: NetworkReport) -> Table:
    table = Table("batch", "median ms a run", "ms an input", box=box.SIMPLE_HEAD, show_edge=False)
    for batch, taken in network.run_ms.items():
        table.add_row(str(batch), f"{taken:.2f}", f"{taken / batch:.3f}")
    return table
