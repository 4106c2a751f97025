"""`make capacity`: measures nodes on this machine, and checks the simulation with them."""

from __future__ import annotations

import json
import math
import signal
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import wraps
from pathlib import Path
from typing import Any, Final, ParamSpec, get_args

import click

from capacity.calibration import Calibration
from capacity.comparison import compare, summary, table
from capacity.cpu_group import CpuGroupError
from capacity.limits import LIMITS, measure_limits
from capacity.load import Load
from capacity.measurement import Engine, Measurement, cases, load_frames, read_runs
from capacity.simulated_camera import Network
from capacity.simulated_node import NodeShape
from capacity.simulation import BALANCERS, Balancer, Scenario, simulate
from lanestream.errors import LanestreamError
from lanestream.protocol import Mode

P = ParamSpec("P")

# A node with the real engine, measured for docs/capacity.md.
_CALIBRATION: Final = Path(__file__).parent / "calibration.json"
_OUT = click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), default=Path("out/capacity"), show_default=True
)
_MOST_CAMERAS: Final = 1_000_000


def _one_line_errors(command: Callable[P, None]) -> Callable[P, None]:
    @wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except (CpuGroupError, LanestreamError, RuntimeError, OSError, ValueError) as error:
            raise click.ClickException(str(error)) from error

    return run


@click.group()
def main() -> None:
    """Plan the capacity of a service: measure nodes, simulate more of them, and check the simulation."""


@main.command()
@click.option("--repeats", type=click.IntRange(1), default=3, show_default=True, help="Runs of each case.")
@click.option("--seconds", type=click.FloatRange(1.0), default=10.0, show_default=True, help="Seconds of each run.")
@click.option("--minutes", type=click.FloatRange(0.1), help="Stop after so long. The next call goes on.")
@click.option("--only", default="", metavar="TEXT", help="Only the cases that have this in their names.")
@click.option("--list", "listing", is_flag=True, help="Print the names of all cases, and exit.")
@_OUT
@_one_line_errors
def measure(repeats: int, seconds: float, minutes: float | None, only: str, listing: bool, out: Path) -> None:
    """Measure one, two and three nodes on this machine under several loads.

    Finished runs are kept in --out, and not measured again. Needs redis-server, and root for the processor limits.
    """
    selected = [case for case in cases() if only in case.name]
    if not selected:
        raise click.UsageError(f"no case has {only!r} in its name; --list prints them")
    if listing:
        for case in selected:
            click.echo(case.name)
        return
    until = None if minutes is None else time.monotonic() + 60.0 * minutes
    if not Measurement(out, seconds, click.echo).run(repeats, selected, until):
        click.echo("runs are missing still; call this again to go on")


@main.command()
@click.option("--json", "path", type=click.Path(path_type=Path, dir_okay=False), help="Write the comparison to a file.")
@_OUT
@_one_line_errors
def check(path: Path | None, out: Path) -> None:
    """Compare the simulation with the runs of `measure`. The exit status is 1 if a figure differs too much."""
    runs = list(read_runs(out))
    if not runs:
        raise click.ClickException(f"{out} has no runs; `measure` makes them")
    names = {run["case"] for run in runs}
    found = [case for case in cases() if case.name in names]
    engines: set[Engine] = {case.engine for case in found}
    calibrations = {engine: Calibration.read(out / f"calibration-{engine}.json") for engine in engines}
    comparisons = list(compare(found, runs, calibrations))
    for line in (*table(comparisons), "", *summary(comparisons)):
        click.echo(line)
    if path is not None:
        rows = [{**asdict(each), "deviation": each.deviation} for each in comparisons]
        path.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    if not all(each.is_close for each in comparisons):
        raise SystemExit(1)


@main.command()
@click.argument("names", nargs=-1, type=click.Choice(LIMITS), metavar="[NAME]...")
@click.option("--seconds", type=click.FloatRange(0.5), default=4.0, show_default=True, help="Seconds of each load.")
@_OUT
@_one_line_errors
def limits(names: tuple[str, ...], seconds: float, out: Path) -> None:
    """Measure what a stream needs, and where Redis and proxies saturate: stream, redis, nginx or haproxy.

    Without a NAME everything is measured that is installed here.
    """
    out.mkdir(parents=True, exist_ok=True)
    frames = load_frames(out / "frames")
    found: dict[str, Any] = {}
    for name, figures in measure_limits(names, frames, out, seconds):
        found[name] = figures
        (out / "limits.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
        click.echo(name)
        for key, value in figures.items():
            click.echo(f"  {key:24}{value if isinstance(value, str | bool) else f'{value:,.6g}'}")


def _rate(context: click.Context, parameter: click.Parameter, value: str) -> float | None:
    """Reads frames per second; `max` is None."""
    if value == "max":
        return None
    try:
        rate = float(value)
    except ValueError:
        rate = math.nan
    if not 0.0 < rate < math.inf:
        raise click.BadParameter(f"{value!r} is not a number above 0, or max", context, parameter)
    return rate


@main.command(name="simulate")
@click.option("--nodes", type=click.IntRange(1), default=1, show_default=True)
@click.option("--workers", type=click.IntRange(1), default=2, show_default=True, help="Worker processes of a node.")
@click.option("--processors", type=click.IntRange(1), default=2, show_default=True, help="Processors of a node.")
@click.option("--limit", type=click.FloatRange(0.01), help="Processor time of a node per second  [default: all]")
@click.option("--cameras", type=click.IntRange(1, _MOST_CAMERAS), default=4, show_default=True, help="For all nodes.")
@click.option("--fps", default="15", callback=_rate, show_default=True, help="Frames per second of a camera, or max.")
@click.option("--mode", type=click.Choice(get_args(Mode)), default="latest", show_default=True)
@click.option("--in-flight", type=click.IntRange(1, 8), default=8, show_default=True, help="Unanswered frames.")
@click.option("--balancer", type=click.Choice(BALANCERS), default="rotated", show_default=True)
@click.option("--network-ms", type=click.FloatRange(0.0), help="Delay in one direction  [default: as calibrated]")
@click.option("--jitter-ms", type=click.FloatRange(0.0), default=0.0, show_default=True, help="Mean further delay.")
@click.option("--lose-at", type=click.FloatRange(0.0), help="Second in which the first node is lost.")
@click.option("--detect-s", type=click.FloatRange(0.0), default=0.0, help="Seconds until clients notice the loss.")
@click.option("--wait-ms", type=click.FloatRange(0.0), help="Time on a device instead of the workers' processor time.")
@click.option("--seconds", type=click.FloatRange(1.0), default=30.0, show_default=True)
@click.option("--seed", type=int, default=0, show_default=True)
@click.option(
    "--calibration",
    "path",
    type=click.Path(path_type=Path, dir_okay=False),
    default=_CALIBRATION,
    help="Service times, from `measure`  [default: those of docs/capacity.md]",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
@_one_line_errors
def simulate_command(path: Path, as_json: bool, seed: int, **options: Any) -> None:
    """Simulate cameras that stream to nodes."""
    calibration = Calibration.read(path)
    if options["wait_ms"] is not None:
        calibration = calibration.on_device(1e-3 * options["wait_ms"])
    scenario = _scenario(calibration, **options)
    result = simulate(scenario, calibration, seed)
    if as_json:
        click.echo(json.dumps(asdict(result)))
        return
    outcome = result.outcome
    click.echo(f"answered        {outcome.answered_per_s:.1f} frames/s, {outcome.dropped_share:.1%} dropped")
    click.echo(f"response        p50 {outcome.p50_ms:.1f} ms, p95 {outcome.p95_ms:.1f} ms, p99 {outcome.p99_ms:.1f} ms")
    click.echo(f"queue           p50 {result.queue_p50_ms:.1f} ms, p95 {result.queue_p95_ms:.1f} ms")
    click.echo(f"utilization     processors {result.processor:.0%}, workers {result.workers:.0%}")
    click.echo(f"Redis           {result.saves_per_s:.1f} saves/s")
    if scenario.lose_at is not None:
        times = sorted(result.resumed_s)
        last = f"half of them within {times[len(times) // 2]:.2f} s, all within {times[-1]:.2f} s" if times else "none"
        click.echo(f"resumed         {len(times)} streams, {last}; {result.gave_up} gave up")
        click.echo(f"reconnecting    {result.attempts} attempts")


def _scenario(
    calibration: Calibration,
    *,
    nodes: int,
    cameras: int,
    fps: float | None,
    mode: Mode,
    in_flight: int,
    workers: int,
    processors: int,
    limit: float | None,
    balancer: Balancer,
    network_ms: float | None,
    jitter_ms: float,
    detect_s: float,
    lose_at: float | None,
    seconds: float,
    wait_ms: float | None,
) -> Scenario:
    del wait_ms
    if limit is not None and limit > processors:
        raise click.UsageError(f"--limit {limit:g} is more than the {processors} --processors")
    if lose_at is not None and nodes == 1:
        raise click.UsageError("--lose-at needs at least two --nodes")
    if lose_at is not None and lose_at >= seconds:
        raise click.UsageError(f"--lose-at {lose_at:g} is not within the --seconds {seconds:g}")
    delay_s = calibration.network_s if network_ms is None else 1e-3 * network_ms
    return Scenario(
        nodes,
        Load(cameras, fps, mode, in_flight),
        NodeShape(workers, processors, limit),
        seconds,
        balancer,
        Network(delay_s, 1e-3 * jitter_ms, detect_s),
        lose_at,
    )


if __name__ == "__main__":
    # What was started must end in both cases.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    main()
