"""`make bench`: measures, and writes out/bench.json and out/bench.png."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import click

from bench.frames import load_clips
from bench.measure import benchmark, run_suite
from bench.plot import plot
from bench.report import markdown, report
from bench.runners import litserve_installed
from bench.workload import QUICK, Suite
from lanestream.errors import LanestreamError
from lanestream.inference.providers import AUTO, PROVIDER_NAMES


@click.command()
@click.option("--quick", is_flag=True, help="Takes about a minute, to see that it works; the numbers are rough.")
@click.option("--rounds", type=click.IntRange(1), help="Rounds over all workloads  [default: 5]")
@click.option("--soak-minutes", type=click.FloatRange(0.01), help="Minutes of overload at the end  [default: 0.5]")
@click.option("--clip", help="A video or a folder of images  [default: a rendered drive]")
@click.option("--frames", type=click.IntRange(1), default=24, show_default=True, help="Frames of it to send.")
@click.option("--provider", type=click.Choice(PROVIDER_NAMES), default=AUTO, show_default=True)
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=Path("out"), show_default=True)
def main(
    quick: bool,
    rounds: int | None,
    soak_minutes: float | None,
    clip: str | None,
    frames: int,
    provider: str,
    out: Path,
) -> None:
    """Compare the service with the in-process pipeline, a baseline service and LitServe, on the same frames."""
    suite = QUICK if quick else Suite()
    suite = replace(suite, rounds=rounds or suite.rounds, soak_minutes=soak_minutes or suite.soak_minutes)
    try:
        measure(suite, provider, clip, frames, out)
    except (LanestreamError, RuntimeError, OSError) as error:
        raise click.ClickException(str(error)) from error


def measure(suite: Suite, provider: str, clip: str | None, frames: int, out: Path) -> None:
    """Measures `suite`, writes the report and its figure into the folder `out` and prints the tables."""
    if not litserve_installed():
        click.echo("LitServe is not installed and is left out (to compare with it: pip install -e '.[bench-litserve]')")
    out.mkdir(parents=True, exist_ok=True)
    clips = load_clips(suite.sizes, frames, clip)
    source = "a rendered drive" if clip is None else Path(clip).name
    count = len(clips[suite.sizes[0]])
    with benchmark(clips, provider, out) as bench:
        results = run_suite(bench, suite, click.echo)
        content = report(results, suite, bench.info, f"{count} frames of {source}")
    path = out / "bench.json"
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    plot(content, out / "bench.png")
    for line in markdown(content):
        click.echo(line)
    click.echo(f"\nwrote {path} and {path.with_suffix('.png')}")


if __name__ == "__main__":
    main()
