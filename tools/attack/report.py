"""The outcome of an attack, its verdict, and the table of all of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from attack.definition import Attack
from attack.observer import Beat, Observation

_MOST_MB: Final = 1024.0
# Memory that may stay in use after an attack.
_LEFT_SHARE: Final = 1.1
_LEFT_MB: Final = 50.0
# The least share of the answers without the attack.
_FAIR_SHARE: Final = 0.8
# If the observer itself was later, its figures say little.
_LATE_S: Final = 0.3
_COLUMNS: Final = (
    "attack",
    "camera p95, worst (ms)",
    "frames answered",
    "new camera worst (ms)",
    "/healthz p95, worst (ms)",
    "memory before, at most, after (MB)",
    "verdict",
)


@dataclass(frozen=True)
class Felt:
    """How long answers took in milliseconds: the 95th percentile during the attack, and the worst until the rest ended.

    `sent` frames, new cameras or health checks were due during the attack, `answered` of them had an answer.
    """

    p95_ms: float
    worst_ms: float
    sent: int
    answered: int


@dataclass(frozen=True)
class Memory:
    """The resident memory of the service and its workers in MB: before, at most, and after the rest."""

    before: float
    most: float
    after: float


@dataclass(frozen=True)
class Outcome:
    """What an attack did. It failed if there are `failures`. `share` are the answers relative to those without it."""

    attack: str
    description: str
    camera: Felt
    newcomer: Felt
    health: Felt
    memory: Memory
    share: float | None
    late_ms: float
    refusals: Mapping[str, int]
    failures: Sequence[str] = field(default=())

    @property
    def verdict(self) -> str:
        """One line: `holds`, or what failed."""
        return "holds" if not self.failures else "**fails**: " + "; ".join(self.failures)


def felt(beats: Sequence[Beat], began: float, ended: float) -> Felt:
    """Returns what was felt during an attack that lasted from `began` to `ended`, and until now."""
    during = [beat for beat in beats if began <= beat.due < ended]
    waits = sorted(beat.wait_s for beat in during)
    p95 = waits[math.ceil(0.95 * len(waits)) - 1] if waits else 0.0
    worst = max((beat.wait_s for beat in beats if beat.due + beat.wait_s >= began), default=0.0)
    answered = sum(beat.answered for beat in during)
    return Felt(round(1e3 * p95, 1), round(1e3 * worst, 1), len(during), answered)


def failures(
    attack: Attack, outcome: Outcome, observation: Observation, unexpected: str | None, *, traceback: bool
) -> Iterator[str]:
    """Yields what failed, one line each. `unexpected` is what the attack itself did not expect."""
    facts = {
        unexpected or "": unexpected is not None,
        "the service took so much memory that it was killed": observation.killed,
        "the log has a traceback": traceback,
    }
    yield from (fact for fact, is_true in facts.items() if is_true)
    if outcome.camera.worst_ms > 1e3 * attack.worst_s:
        yield f"a normal camera waited for {outcome.camera.worst_ms / 1e3:.1f} s"
    for who, what in (("new cameras were", outcome.newcomer), ("/healthz was", outcome.health)):
        if what.worst_ms > 1e3 * attack.lockout_s:
            yield f"{who} locked out for {what.worst_ms / 1e3:.1f} s"
    if outcome.share is not None and outcome.share < _FAIR_SHARE:
        yield f"normal cameras got {outcome.share:.1%} of the answers that they get alone"
    if outcome.memory.most > _MOST_MB:
        yield f"{outcome.memory.most:.0f} MB"
    if not memory_is_back(outcome.memory.before, outcome.memory.after):
        yield f"{outcome.memory.after - outcome.memory.before:.0f} MB are left after the rest"
    if outcome.late_ms > 1e3 * _LATE_S:
        yield f"measured badly: the observer itself was {outcome.late_ms:.0f} ms late"


def memory_is_back(before: float, after: float) -> bool:
    """Returns whether hardly more memory is in use `after` an attack than `before`, in MB."""
    return after <= _LEFT_SHARE * before + _LEFT_MB


def table(outcomes: Iterable[Outcome]) -> Iterator[str]:
    """Yields the lines of the table in Markdown."""
    for cells in (_COLUMNS, ("---",) * len(_COLUMNS), *map(_cells, outcomes)):
        yield "| " + " | ".join(cells) + " |"


def _cells(outcome: Outcome) -> tuple[str, ...]:
    camera, health, memory = outcome.camera, outcome.health, outcome.memory
    share = "" if outcome.share is None else f" ({outcome.share:.2f} of alone)"
    return (
        f"`{outcome.attack}`: {outcome.description}",
        f"{camera.p95_ms:.0f}, {camera.worst_ms:.0f}",
        f"{camera.answered} of {camera.sent}{share}",
        f"{outcome.newcomer.worst_ms:.0f}",
        f"{health.p95_ms:.0f}, {health.worst_ms:.0f}",
        f"{memory.before:.0f}, {memory.most:.0f}, {memory.after:.0f}",
        outcome.verdict,
    )
