"""`make attack`: attacks services that it starts, prints what normal cameras felt, and writes out/attack.json."""

from __future__ import annotations

import json
import signal
from dataclasses import asdict
from pathlib import Path

import click
from bench.frames import load_clips
from bench.workload import LARGE

from attack.catalog import ATTACKS, select
from attack.definition import Attack, UnexpectedError
from attack.observer import ObserverError
from attack.report import Outcome, table
from attack.runner import Pace, Runner, raise_file_limit

_REST_S = 60.0
_SHORT_REST_S = 5.0
_FRAMES = 8


@click.command()
@click.option("--only", multiple=True, metavar="NAME", help="An attack or a kind of attacks; can be repeated.")
@click.option("--short", is_flag=True, help="Take 3 seconds for each attack, with fewer connections.")
@click.option("--rest", type=click.FloatRange(0.0), help="Seconds until memory must be back  [default: 60; short: 5]")
@click.option(
    "--json",
    "path",
    type=click.Path(path_type=Path, dir_okay=False),
    default=Path("out/attack.json"),
    show_default=True,
    help="Report to write; the logs of the services go to the same folder.",
)
@click.option("--list", "listing", is_flag=True, help="Print the names of all attacks, and exit.")
def main(only: tuple[str, ...], short: bool, rest: float | None, path: Path, listing: bool) -> None:
    """Attack services that this command starts on 127.0.0.1, one attack after the other.

    The exit status is 1 if a service did not withstand an attack.
    """
    if listing:
        for attack in ATTACKS:
            click.echo(f"{attack.name:32}{attack.description}")
        return
    try:
        attacks = select(only)
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    path.parent.mkdir(parents=True, exist_ok=True)
    raise_file_limit()
    # Whoever started this in the background may have made it ignore the signals by which services are stopped.
    for number in (signal.SIGHUP, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL)
    pace = Pace(short, rest if rest is not None else _SHORT_REST_S if short else _REST_S)
    runner = Runner(load_clips((LARGE,), _FRAMES)[LARGE], path.parent, pace)
    outcomes = []
    for attack in attacks:
        outcomes.append(_run(runner, attack))
        path.write_text(json.dumps([asdict(each) for each in outcomes], indent=2) + "\n", encoding="utf-8")
    click.echo()
    for line in table(outcomes):
        click.echo(line)
    failed = sum(bool(outcome.failures) for outcome in outcomes)
    click.echo(f"\n{len(outcomes) - failed} of {len(outcomes)} attacks were withstood; wrote {path}")
    if failed:
        raise SystemExit(1)


def _run(runner: Runner, attack: Attack) -> Outcome:
    try:
        outcome = runner.run(attack)
    except (ObserverError, UnexpectedError) as error:
        raise click.ClickException(f"{attack.name}: {error}") from error
    click.echo(f"{outcome.attack:32}{outcome.verdict}")
    return outcome


if __name__ == "__main__":
    main()
