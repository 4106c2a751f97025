"""Compares the available providers on the shipped networks: milliseconds per input, and how far the outputs differ.

Times are the minimum of many runs. The providers alternate, so that a busy machine slows all of them. Inputs are
patches and road crops of rendered roads.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import click
import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

from lanestream.detection.interface import ModelRole
from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR, load_engine
from lanestream.errors import ProviderError
from lanestream.inference.loaded_model import LoadedModel
from lanestream.inference.loading import load_model
from lanestream.inference.providers import PROVIDERS, RuntimeOptions
from lanestream.road.view import Image
from lanestream_exporter.scenes import render_still, sample_scene

_FILES: Final = (SHIPPED_MODEL, SHIPPED_MODEL.with_name("classifier-fp32.onnx"), SHIPPED_REGRESSOR)
_BATCHES: Final = (1, 2, 4, 8, 9, 12, 16)
_SCENES: Final = 16

Inputs = NDArray[np.uint8]


@click.command()
@click.option("--threads", type=click.IntRange(1), help="Threads per run  [default: one per processor]")
@click.option("--rounds", type=click.IntRange(1), default=60, show_default=True, help="Runs at each batch size.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the numbers to this file, too.")
def main(threads: int | None, rounds: int, json_file: Path | None) -> None:
    """Compare the available providers on the shipped networks."""
    inputs_of = network_inputs(rendered_scenes())
    patches, crops = inputs_of["classifier"], inputs_of["regressor"]
    table = Table("network", "provider", *map(str, _BATCHES), "mean difference", "max difference", box=box.SIMPLE)
    report = []
    for path in _FILES:
        inputs = crops if path == SHIPPED_REGRESSOR else patches
        networks = _networks(path, RuntimeOptions(threads))
        times = _times(networks, inputs, rounds)
        expected = networks["cpu"].run(inputs)
        for provider, network in networks.items():
            difference = np.abs(network.run(inputs) - expected)
            mean, greatest = float(difference.mean()), float(difference.max())
            milliseconds = [f"{times[provider, batch]:.2f}" for batch in _BATCHES]
            table.add_row(path.stem, provider, *milliseconds, f"{mean:.6f}", f"{greatest:.6f}")
            by_batch = {batch: round(times[provider, batch], 3) for batch in _BATCHES}
            report.append({"network": path.stem, "provider": provider, "ms": by_batch, "mean": mean, "max": greatest})
    # In a pipe rich would assume 80 columns, which are too few.
    console = Console(width=120)
    console.print(table, f"ms per input by batch size; {len(patches)} patches, {len(crops)} road crops")
    if json_file is not None:
        json_file.write_text(json.dumps(report, indent=2))


def rendered_scenes() -> list[Image]:
    """Returns pictures of rendered roads."""
    rng = np.random.default_rng(5)
    return [render_still(sample_scene(rng, 640, 360)).image for _ in range(_SCENES)]


def network_inputs(images: Sequence[Image]) -> Mapping[ModelRole, Inputs]:
    """Returns what the classifier and the regressor get for `images`, of which each is the first of a session."""
    engine = load_engine(provider="cpu")
    inputs: dict[ModelRole, list[Inputs]] = {"classifier": [], "regressor": []}

    def infer(role: ModelRole, batch: Inputs) -> NDArray[np.float32]:
        inputs[role].append(batch)
        return engine.models[role].run(batch)

    for image in images:
        engine.open_session().process(image, 0.0, infer)
    return {role: np.concatenate(batches) for role, batches in inputs.items()}


def _networks(path: Path, options: RuntimeOptions) -> Mapping[str, LoadedModel]:
    networks = {}
    for provider in PROVIDERS:
        try:
            networks[provider.name] = load_model(path, provider.name, options)
        except ProviderError:
            continue
        networks[provider.name].warm_up()
    return networks


def _times(networks: Mapping[str, LoadedModel], inputs: Inputs, rounds: int) -> Mapping[tuple[str, int], float]:
    """Returns milliseconds per input by provider and batch size."""
    fastest: dict[tuple[str, int], float] = {}
    for batch in _BATCHES:
        part = inputs[:batch]
        for _ in range(rounds):
            for provider, network in networks.items():
                started = time.perf_counter()
                network.run(part)
                milliseconds = 1e3 * (time.perf_counter() - started) / batch
                fastest[provider, batch] = min(milliseconds, fastest.get((provider, batch), milliseconds))
    return fastest


if __name__ == "__main__":
    main()
