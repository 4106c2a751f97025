"""`make bench`: measures, and writes out/bench.json and out/bench.png."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import click

from bench.figures import figures
from bench.frames import load_clips
from bench.measuring import bench
from bench.plan import QUICK, Plan
from bench.plot import plot
from bench.running import run
from bench.table import markdown
from lanestream.errors import LanestreamError
from lanestream.runtime import PROVIDERS, Provider


@click.command()
@click.option("--quick", is_flag=True, help="About a minute, to see that it works; the figures are rough.")
@click.option("--rounds", type=click.IntRange(1), help="How often everything is measured  [default: 5]")
@click.option("--soak-minutes", type=click.FloatRange(0.01), help="How long too many frames are pushed  [default: 0.5]")
@click.option("--clip", help="A video or a folder of images  [default: a rendered drive]")
@click.option("--frames", type=click.IntRange(1), default=24, show_default=True, help="Frames of it that are sent.")
@click.option("--provider", type=click.Choice(PROVIDERS), default="auto", show_default=True)
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=Path("out"), show_default=True)
def main(
    quick: bool,
    rounds: int | None,
    soak_minutes: float | None,
    clip: str | None,
    frames: int,
    provider: Provider,
    out: Path,
) -> None:
    """Measure the service, the pipeline in process, a naive service and LitServe on the same frames, by turns."""
    plan = QUICK if quick else Plan()
    plan = replace(plan, rounds=rounds or plan.rounds, soak_minutes=soak_minutes or plan.soak_minutes)
    try:
        measure(plan, provider, clip, frames, out)
    except (LanestreamError, RuntimeError, OSError) as error:
        raise click.ClickException(str(error)) from error


def measure(plan: Plan, provider: Provider, clip: str | None, frames: int, out: Path) -> None:
    """Goes through `plan` and writes what it came to into the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    clips = load_clips(plan.sizes, frames, clip)
    source = "a rendered drive" if clip is None else Path(clip).name
    count = len(clips[plan.sizes[0]])
    with bench(clips, provider, out) as contestants:
        results = run(contestants, plan, click.echo)
        told = figures(results, plan, contestants.hello, f"{count} frames of {source}")
    path = out / "bench.json"
    path.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
    plot(told, out / "bench.png")
    for line in markdown(told):
        click.echo(line)
    click.echo(f"\nwrote {path} and {path.with_suffix('.png')}")


if __name__ == "__main__":
    main()
