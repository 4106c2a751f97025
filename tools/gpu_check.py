"""`make gpu-check`: checks and measures the networks and the service on an NVIDIA GPU, in a few minutes.

Each step runs in a process of its own with a time limit. A step that fails, crashes or hangs does not keep the others
from running. What steps have found is kept in the output folder: an interrupted check continues, and a step that failed
runs again. `--provider cpu` runs the same steps on a machine without a GPU.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import click

from lanestream import __version__
from lanestream.errors import LanestreamError, one_line

try:
    import gpu_steps
    from gpu_steps import Plan, Report
except ModuleNotFoundError as error:
    sys.exit(f"error: the package {error.name} is not installed (pip install '.[gpu-check]')")

from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR
from lanestream.gpu import gpu
from lanestream.host import cpu
from lanestream.inference.providers import CPU, CUDA
from lanestream.packages import owner_versions

_DONE: Final = ("passed", "skipped")


@dataclass(frozen=True)
class Step:
    """A step: what it runs, for at most how many seconds, and whether it needs what step `inputs` writes."""

    name: str
    run: Callable[[Plan], Report]
    limit_s: float
    needs_inputs: bool = True


@dataclass
class Outcome:
    """What came of a step: `passed`, `failed`, `skipped` or `not run`, and what it reported."""

    status: str
    seconds: float = 0.0
    report: Report = field(default_factory=Report)


DOCTOR: Final = Step("doctor", gpu_steps.doctor, 120.0, needs_inputs=False)
INPUTS: Final = Step("inputs", gpu_steps.inputs, 120.0, needs_inputs=False)
STEPS: Final = (
    DOCTOR,
    INPUTS,
    Step("nodes", gpu_steps.nodes, 60.0),
    Step("parity", gpu_steps.parity, 90.0),
    Step("batches", gpu_steps.batches, 120.0),
    Step("binding", gpu_steps.binding, 120.0),
    Step("tensorrt", gpu_steps.tensorrt, 300.0),
    Step("load", gpu_steps.load, 240.0, needs_inputs=False),
)


@click.command()
@click.option("--provider", type=click.Choice([CUDA.name, CPU.name]), default=CUDA.name, show_default=True)
@click.option("--frames", help="A video or a folder of images  [default: rendered roads]")
@click.option(
    "--model",
    "models",
    multiple=True,
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="A model file to check, too; repeatable.",
)
@click.option("--sessions", type=click.IntRange(1), default=32, show_default=True, help="Cameras of the load.")
@click.option(
    "--step",
    "names",
    multiple=True,
    type=click.Choice([step.name for step in STEPS]),
    help="Only these steps, and what they need; repeatable.",
)
@click.option("--again", is_flag=True, help="Run steps that passed, too.")
@click.option("--quick", is_flag=True, help="Measure less, to see that it works; the numbers are rough.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=Path("out"), show_default=True)
def main(
    provider: str,
    frames: str | None,
    models: tuple[Path, ...],
    sessions: int,
    names: tuple[str, ...],
    again: bool,
    quick: bool,
    out: Path,
) -> None:
    """Check the networks and the service on an NVIDIA GPU; writes gpu_check.json and gpu_check.txt."""
    folder = out.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    plan = Plan(provider, folder, frames, models, sessions, quick)
    steps = [step for step in STEPS if not names or step.name in names or step in (DOCTOR, INPUTS)]
    try:
        check = Check(plan, again=again)
        check.run(steps)
    except (LanestreamError, OSError) as error:
        raise click.ClickException(str(error)) from error
    sys.exit(0 if all(check.outcomes[step.name].status in _DONE for step in steps) else 1)


class Check:
    """Runs steps, prints a line or more on each, and writes what is known after each one."""

    def __init__(self, plan: Plan, *, again: bool = False) -> None:
        self._plan = plan
        self._machine = machine()
        self._fingerprint = fingerprint(plan, self._machine)
        self.outcomes = {} if again else kept_outcomes(plan, self._fingerprint)

    def run(self, steps: Sequence[Step]) -> None:
        """Runs the steps that have not passed yet."""
        click.echo(heading(self._plan, self._machine))
        for step in steps:
            if not self._is_done(step.name):
                self.outcomes[step.name] = self._outcome(step)
                self._write()
            for line in outcome_lines(step.name, self.outcomes[step.name]):
                click.echo(line)
        click.echo(f"wrote {results_file(self._plan)} and {results_file(self._plan).with_suffix('.txt')}")

    def _outcome(self, step: Step) -> Outcome:
        if step is not DOCTOR and not self._provider_works():
            return Outcome("not run")
        if step.needs_inputs and not self._is_done(INPUTS.name):
            return Outcome("not run")
        return run_step(step, self._plan)

    def _provider_works(self) -> bool:
        """Returns whether the doctor has run a network on the provider."""
        networks = self.outcomes[DOCTOR.name].report.figures.get("networks", ())
        return any(network["provider"] == self._plan.provider for network in networks)

    def _is_done(self, name: str) -> bool:
        return name in self.outcomes and self.outcomes[name].status in _DONE

    def _write(self) -> None:
        known = {step.name: self.outcomes[step.name] for step in STEPS if step.name in self.outcomes}
        content = {
            "fingerprint": self._fingerprint,
            "version": __version__,
            "provider": self._plan.provider,
            "machine": self._machine,
            "passed": all(outcome.status in _DONE for outcome in known.values()),
            "steps": {name: asdict(outcome) for name, outcome in known.items()},
        }
        lines = [heading(self._plan, self._machine)]
        lines += [line for name, outcome in known.items() for line in outcome_lines(name, outcome)]
        path = results_file(self._plan)
        path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        path.with_suffix(".txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def run_step(step: Step, plan: Plan) -> Outcome:
    """Runs a step in a process of its own, whose output goes to a file, and ends it after the time limit."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    log = plan.folder / f"gpu_check_{step.name}.log"
    process = context.Process(target=_run_in_process, args=(theirs, log, step.run, plan))
    started = time.monotonic()
    process.start()
    theirs.close()
    try:
        report = ours.recv() if ours.poll(step.limit_s) else f"not done after {step.limit_s:.0f} s"
    except EOFError:
        process.join()
        report = f"its process ended with code {process.exitcode}"
    finally:
        # The servers and load generators of a step belong to its group.
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.kill()
        process.join()
    seconds = time.monotonic() - started
    if isinstance(report, str):
        return Outcome("failed", seconds, Report(failures=[f"{report} (output in {log})"]))
    if report.skipped is not None:
        return Outcome("skipped", seconds, report)
    return Outcome("failed" if report.failures else "passed", seconds, report)


def _run_in_process(pipe: Connection, log: Path, run: Callable[[Plan], Report], plan: Plan) -> None:
    """Sends the report of a step, or a line about the error that ended it; the target of a process."""
    os.setsid()
    with log.open("wb") as file:
        # Libraries in C write there directly.
        os.dup2(file.fileno(), sys.stdout.fileno())
        os.dup2(file.fileno(), sys.stderr.fileno())
    try:
        report: Report | str = run(plan)
    except LanestreamError as error:
        report = str(error)
    except Exception as error:
        report = f"{type(error).__name__}: {one_line(str(error))}"
        pipe.send(report)
        raise
    pipe.send(report)


def machine() -> dict[str, Any]:
    """Returns what the check runs on."""
    return {"cpu": asdict(cpu()), "gpu": asdict(gpu()), "software": dict(owner_versions("onnxruntime"))}


def heading(plan: Plan, found: Mapping[str, Any]) -> str:
    """Returns a line about the machine."""
    devices = "; ".join(found["gpu"]["devices"]) or "no GPU"
    software = ", ".join(f"{name} {version}" for name, version in found["software"].items())
    where = f"{devices}, driver {found['gpu']['driver'] or 'none'}, CUDA {found['gpu']['cuda'] or 'none'}"
    return f"Lanestream {__version__} on {plan.provider}: {where}, {found['cpu']['used']} processors, {software}"


def outcome_lines(name: str, outcome: Outcome) -> list[str]:
    """Returns the lines about a step for people."""
    report = outcome.report
    rest = f" ({report.skipped})" if report.skipped is not None else f"  {outcome.seconds:.1f} s"
    failures = [f"  FAILED  {failure}" for failure in report.failures]
    return [f"{outcome.status:8}{name}{rest}", *(f"        {line}" for line in report.lines), *failures]


def results_file(plan: Plan) -> Path:
    """Returns the path of the results."""
    return plan.folder / "gpu_check.json"


def fingerprint(plan: Plan, found: Mapping[str, Any]) -> str:
    """Returns a hash of what results depend on: those with another one are not kept."""
    files = [SHIPPED_MODEL, gpu_steps.FP32_CLASSIFIER, SHIPPED_REGRESSOR, *plan.models]
    models = [hashlib.sha256(path.read_bytes()).hexdigest() for path in files]
    known = [__version__, found, plan.provider, plan.frames, plan.sessions, plan.quick, models]
    return hashlib.sha256(json.dumps(known).encode()).hexdigest()


def kept_outcomes(plan: Plan, known: str) -> dict[str, Outcome]:
    """Returns what an earlier check with the fingerprint `known` has found; nothing if there is none."""
    try:
        content = json.loads(results_file(plan).read_text(encoding="utf-8"))
        if content["fingerprint"] != known:
            return {}
        steps = content["steps"].items()
        return {name: Outcome(each["status"], each["seconds"], Report(**each["report"])) for name, each in steps}
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        return {}


if __name__ == "__main__":
    # So that the processes of a step end, too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    main()
