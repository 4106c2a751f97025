"""Compares the simulation with what was measured."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Final

from capacity.calibration import Calibration
from capacity.load import Load
from capacity.measurement import CORES, LOSS_AFTER_S, Case, Engine
from capacity.simulated_node import NodeShape
from capacity.simulation import WARM_UP_S, Scenario, SimulationResult, simulate

# The simulation should be this close.
TOLERANCE: Final = 0.15
# The figures that are compared, and their names.
FIGURES: Final = {"answered_per_s": "frames/s", "p50_ms": "p50 ms", "p95_ms": "p95 ms"}
_SECONDS: Final = 120.0
_LOSSES: Final = 40
_SEED: Final = 24


@dataclass(frozen=True)
class Comparison:
    """One figure of a case: what the runs measured, and what the simulation predicted from the calibration."""

    case: str
    figure: str
    measured: tuple[float, ...]
    simulated: float

    @property
    def deviation(self) -> float:
        """How much higher the simulation is than the median of the runs, as a share of that."""
        return self.simulated / median(self.measured) - 1.0

    @property
    def is_close(self) -> bool:
        """Whether the deviation is within the tolerance."""
        return abs(self.deviation) <= TOLERANCE


def scenario_of(case: Case) -> Scenario:
    """Returns what is simulated for a case."""
    load = Load(case.load.cameras * case.nodes, case.load.fps, case.load.mode, case.load.in_flight)
    shape = NodeShape(limit=CORES if case.engine == "real" else None)
    lose_at = LOSS_AFTER_S - WARM_UP_S if case.loss else None
    return Scenario(case.nodes, load, shape, 10.0 if case.loss else _SECONDS, lose_at=lose_at)


def compare(
    cases: Sequence[Case], runs: Sequence[Mapping[str, Any]], calibrations: Mapping[Engine, Calibration]
) -> Iterator[Comparison]:
    """Yields the comparisons of all cases that have runs."""
    for case in cases:
        found = [run for run in runs if run["case"] == case.name]
        if not found:
            continue
        if case.loss:
            measured = tuple(1e3 * each for run in found for each in run["resumed_s"])
            times = [
                1e3 * each
                for seed in range(_LOSSES)
                for each in simulate(scenario_of(case), calibrations[case.engine], seed).resumed_s
            ]
            yield Comparison(case.name, "resumed ms", measured, median(times))
            continue
        result: SimulationResult = simulate(scenario_of(case), calibrations[case.engine], _SEED)
        for key, name in FIGURES.items():
            yield Comparison(case.name, name, tuple(run[key] for run in found), getattr(result.outcome, key))


def table(comparisons: Sequence[Comparison]) -> Iterator[str]:
    """Yields the lines of a Markdown table, one for each case.

    A cell has the median of the runs with their minimum and maximum, the simulation, and its deviation from the median.
    """
    figures = tuple(dict.fromkeys(each.figure for each in comparisons))
    yield "| " + " | ".join(("case", *figures)) + " |"
    yield "| " + " | ".join(["---"] * (len(figures) + 1)) + " |"
    for case in dict.fromkeys(each.case for each in comparisons):
        cells = {each.figure: _cell(each) for each in comparisons if each.case == case}
        yield "| " + " | ".join((case, *(cells.get(figure, "") for figure in figures))) + " |"


def _cell(each: Comparison) -> str:
    digits = 0 if median(each.measured) >= 100.0 else 1
    low, middle, high = (
        f"{value:.{digits}f}" for value in (min(each.measured), median(each.measured), max(each.measured))
    )
    mark = "" if each.is_close else " **"
    return f"{middle} ({low} to {high}); {each.simulated:.{digits}f}, {each.deviation:+.0%}{mark}"


def summary(comparisons: Sequence[Comparison]) -> Iterator[str]:
    """Yields one line for each figure: how many cases are close, and the largest deviation."""
    for name in dict.fromkeys(each.figure for each in comparisons):
        found = [each for each in comparisons if each.figure == name]
        close = sum(each.is_close for each in found)
        worst = max(found, key=lambda each: abs(each.deviation))
        yield f"{name}: {close} of {len(found)} within {TOLERANCE:.0%}, at most {worst.deviation:+.0%} ({worst.case})"
