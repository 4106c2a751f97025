"""Goes through a plan with all contestants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from bench.measuring import Bench, Sample
from bench.orders import Order
from bench.plan import LARGE, SERVICE, Cell, Plan


@dataclass(frozen=True)
class Overload:
    """Clients that push `rate` frames a second each, and what came of it."""

    clients: int
    rate: float
    sample: Sample


@dataclass
class Results:
    """All samples, by round; the last overload is the `soak`, with the service's memory (MB) before it."""

    cells: list[dict[Cell, Sample]] = field(default_factory=list)
    overloads: list[list[Overload]] = field(default_factory=list)
    soak: Overload | None = None
    memory_before_soak_mb: float = 0.0


def run(bench: Bench, plan: Plan, tell: Callable[[str], None]) -> Results:
    """Measures everything in `plan`; `tell` is given a line about each step."""
    results = Results()
    for number in range(plan.rounds):
        results.cells.append({})
        for cell in plan.round(number):
            sample = bench.measure(cell)
            results.cells[-1][cell] = sample
            tell(f"{number + 1}/{plan.rounds}  {_line(cell, sample)}")
        each = [_overload(bench, plan, results, clients, plan.overload_seconds) for clients in plan.overload_clients]
        results.overloads.append(each)
    results.memory_before_soak_mb = bench.servers[SERVICE].watched.memory_mb()
    tell(f"overload for {plan.soak_minutes:g} minutes")
    results.soak = _overload(bench, plan, results, max(plan.overload_clients), 60.0 * plan.soak_minutes)
    return results


def compared(plan: Plan) -> int:
    """The number of sessions at which contestants are compared: the most that all of them meet in every round."""
    return max(sessions for sessions in plan.sessions if sessions <= plan.few)


def _overload(bench: Bench, plan: Plan, results: Results, clients: int, seconds: float) -> Overload:
    """More than the service answered in this round, from so many clients."""
    (capacity,) = (
        sample.fps
        for cell, sample in results.cells[-1].items()
        if cell == replace(cell, contestant=SERVICE, size=LARGE, sessions=compared(plan), in_flight=2)
    )
    rate = plan.overload_factor * max(capacity, 1.0) / clients
    return Overload(clients, rate, bench.load(SERVICE, Order(LARGE, clients, rate=rate), seconds))


def _line(cell: Cell, sample: Sample) -> str:
    load = f"{cell.size[0]} x {cell.size[1]}, {cell.sessions:2} sessions, {cell.in_flight} in flight"
    return f"{cell.contestant:9} {load}, {cell.detector}: {sample.fps:.1f} frames a second"
