"""The shipped networks on every provider that can be had here: milliseconds an input, and how far answers are apart.

Times are the least of many runs, the providers taking turns: what else the machine does slows all of them alike.
Inputs are patches and canvases of rendered roads.
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

from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR, load_engine
from lanestream.errors import ProviderError
from lanestream.inference import LoadedModel, load_model
from lanestream.runtime import PROVIDERS, RuntimeOptions
from lanestream_exporter.scenes import render_still, sample_scene

_FILES: Final = (SHIPPED_MODEL, SHIPPED_MODEL.with_name("classifier-fp32.onnx"), SHIPPED_REGRESSOR)
_BATCHES: Final = (1, 2, 4, 8, 9, 12, 16)
_SCENES: Final = 16

Inputs = NDArray[np.uint8]


@click.command()
@click.option("--threads", type=click.IntRange(1), help="Threads of a run  [default: one a processor]")
@click.option("--rounds", type=click.IntRange(1), default=60, show_default=True, help="Runs at each batch size.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the figures there, too.")
def main(threads: int | None, rounds: int, json_file: Path | None) -> None:
    """Compare the providers that can be had here."""
    patches, canvases = _inputs()
    table = Table("network", "provider", *map(str, _BATCHES), "mean apart", "most apart", box=box.SIMPLE)
    figures = []
    for path in _FILES:
        inputs = canvases if path == SHIPPED_REGRESSOR else patches
        networks = _networks(path, RuntimeOptions(threads))
        times = _times(networks, inputs, rounds)
        expected = networks["cpu"].run(inputs)
        for provider, network in networks.items():
            apart = np.abs(network.run(inputs) - expected)
            mean, most = float(apart.mean()), float(apart.max())
            milliseconds = [f"{times[provider, batch]:.2f}" for batch in _BATCHES]
            table.add_row(path.stem, provider, *milliseconds, f"{mean:.6f}", f"{most:.6f}")
            by_batch = {batch: round(times[provider, batch], 3) for batch in _BATCHES}
            figures.append({"network": path.stem, "provider": provider, "ms": by_batch, "mean": mean, "most": most})
    # Not to be squeezed into the 80 columns that a pipe counts as.
    console = Console(width=120)
    console.print(table, f"ms an input by batch size; {len(patches)} patches, {len(canvases)} canvases")
    if json_file is not None:
        json_file.write_text(json.dumps(figures, indent=2))


def _inputs() -> Sequence[Inputs]:
    """What the shipped detectors ask the classifier and the regressor about rendered roads."""
    rng = np.random.default_rng(5)
    stills = [render_still(sample_scene(rng, 640, 360)).image for _ in range(_SCENES)]
    return [
        np.concatenate([pipeline.detector.prepare(still).inputs for still in stills])
        for pipeline in load_engine(provider="cpu").pipelines
    ]


def _networks(path: Path, options: RuntimeOptions) -> Mapping[str, LoadedModel]:
    networks = {}
    for provider in PROVIDERS[1:]:
        try:
            networks[provider] = load_model(path, provider, options)
        except ProviderError:
            continue
        networks[provider].warm_up()
    return networks


def _times(networks: Mapping[str, LoadedModel], inputs: Inputs, rounds: int) -> Mapping[tuple[str, int], float]:
    """Milliseconds an input by provider and batch size."""
    least: dict[tuple[str, int], float] = {}
    for batch in _BATCHES:
        part = inputs[:batch]
        for _ in range(rounds):
            for provider, network in networks.items():
                started = time.perf_counter()
                network.run(part)
                taken = 1e3 * (time.perf_counter() - started) / batch
                least[provider, batch] = min(taken, least.get((provider, batch), taken))
    return least


if __name__ == "__main__":
    main()
