"""Measures what fine-tuning on N frames of new roads is worth, and prints the table of docs/training.md.

python tools/fine_tuning.py --data ../shared/data

The new roads are the Brazilian ones, which the first runs of the shipped networks have not seen (`make models`).
Networks are fine-tuned from those runs with the shipped recipes, on frames of the training drives, of which about a
fifth validate. Figures are of the validation drives of all data sets, which no training here uses. Finished steps in
out/ are kept, so it can be interrupted.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Final

import click
import numpy as np
from demo import LANESTREAM

SIZES: Final = (50, 200, 800)
ROADS: Final = "DNIT federal roads"
FOLDER: Final = "brazil_dnit"
MANIFEST: Final = """[[dataset]]
name = "my roads"
path = "labels.jsonl"
format = "clips"
split = { by = "group", val = 0.2 }
group = "segment"
coverage = { ego = true }
horizon = "horizon"
masks = [[0.84, 0.015, 0.99, 0.1]]
"""


@click.command(help=__doc__)
@click.option("--data", type=click.Path(path_type=Path, exists=True), envvar="LANESTREAM_DATA", required=True)
@click.option("--run", "runs", type=click.Path(path_type=Path), default=Path("runs"), show_default=True)
@click.option("--models", type=click.Path(path_type=Path), default=Path("out"), show_default=True)
@click.option("--out", type=click.Path(path_type=Path), default=Path("out/fine-tuning"), show_default=True)
def main(data: Path, runs: Path, models: Path, out: Path) -> None:
    """Fine-tunes and evaluates networks for every number of frames, and prints the table."""
    source = data.resolve() / FOLDER
    if not source.is_dir():
        raise click.ClickException(f"there is nothing at {source} (see `lanestream data fetch {FOLDER}`)")
    before = models / "classifier-first.onnx", models / "regressor-first.onnx"
    rows = [(0, 0.0, evaluated(data, *before, out / "0.json"))]
    for size in SIZES:
        folder = out / str(size)
        networks, minutes = fine_tuned(runs.resolve(), source, folder, size)
        rows.append((size, minutes, evaluated(data, *networks, folder / "evaluation.json")))
    print(
        "| frames | training, minutes | ego right | wrong | missed | error, px | other roads: right | wrong | missed |"
    )
    print("| --- " * 9 + "|")
    for size, minutes, figures in rows:
        print(f"| {size} | {minutes:.0f} | " + " | ".join(str(figure) for figure in row(figures)) + " |")


def fine_tuned(runs: Path, source: Path, folder: Path, size: int) -> tuple[tuple[Path, Path], float]:
    """Trains both networks on `size` frames. Returns the classifier's and the regressor's file, and the minutes."""
    write_frames(source, folder, size)
    manifest = folder / "datasets.toml"
    manifest.write_text(MANIFEST, encoding="utf-8")
    minutes = 0.0
    files = {kind: folder / f"{kind}.onnx" for kind in ("regressor", "classifier")}
    for kind, file in files.items():
        recipe = folder / f"{kind}.toml"
        # The candidates are those of the regressor that will be served.
        text = lanestream_output("train", "recipe", f"{kind}-finetune")
        recipe.write_text(
            text.replace('regressor = "shipped"', f'regressor = "{files["regressor"]}"'), encoding="utf-8"
        )
        run = folder / kind
        options = "--run", run, "--manifest", manifest, "--initial", runs / kind / "best.pt", "--data", folder
        minutes += timed(run / "minutes.txt", "train", kind, recipe, *options)
        served = ("--regressor", files["regressor"]) if kind == "classifier" else ()
        if not file.exists():
            lanestream("export", run / "best.pt", file, *served, "--data", folder)
    return (files["classifier"], files["regressor"]), minutes


def write_frames(source: Path, folder: Path, size: int) -> None:
    """Writes the labels of `size` random frames of the training drives, beside a link to the images."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = (source / "labels.jsonl").read_text(encoding="utf-8").splitlines()
    lines = [line for line in lines if json.loads(line)["split"] == "train"]
    chosen = np.random.default_rng(1).choice(lines, size, replace=False)
    (folder / "labels.jsonl").write_text("\n".join(chosen.tolist()) + "\n", encoding="utf-8")
    images = folder / "images"
    if not images.is_symlink():
        images.symlink_to(source / "images")


def evaluated(data: Path, classifier: Path, regressor: Path, file: Path) -> dict[str, Any]:
    """Returns the figures of the validation drives of all data sets."""
    if not file.exists():
        models = "--model", classifier, "--regressor", regressor
        lanestream("evaluate", *models, "--data", data, "--split", "val", "--labels-only", "--json", file)
    figures: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return figures


def row(figures: dict[str, Any]) -> list[object]:
    """Returns the figures of the ego boundaries of the new roads, then of all others together."""
    sets = {
        name: groups["boundaries"]["ego"]
        for name, groups in figures["datasets"][next(iter(figures["methods"]))].items()
    }
    new = sets.pop(ROADS)
    counts = ("right", "wrong", "missed")
    return [
        *(new[count] for count in counts),
        f"{new['mean_error_px_640']:.2f}",
        *(sum(each[count] for each in sets.values()) for count in counts),
    ]


def timed(file: Path, *arguments: str | Path) -> float:
    """Runs a command unless `file` has the minutes that it took. Returns these."""
    if not file.exists():
        started = time.monotonic()
        lanestream(*arguments)
        file.write_text(f"{(time.monotonic() - started) / 60.0:.2f}", encoding="utf-8")
    return float(file.read_text(encoding="utf-8"))


def lanestream(*arguments: str | Path) -> None:
    """Runs a Lanestream command with its output on the terminal."""
    print("lanestream", *arguments, flush=True)
    subprocess.run([LANESTREAM, *arguments], check=True)


def lanestream_output(*arguments: str) -> str:
    """Returns the output of a Lanestream command."""
    return subprocess.run([LANESTREAM, *arguments], check=True, capture_output=True, text=True).stdout


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)
