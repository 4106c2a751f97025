"""All attacks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from attack import (
    clock,
    connections,
    costly,
    heads,
    logs,
    memory,
    never_read,
    not_frames,
    races,
    redis_outages,
    stops,
    tls,
    workers,
)
from attack.definition import Attack

_MODULES: Final = (
    *(heads, connections, never_read, not_frames, memory, costly, tls),
    *(stops, logs, races, redis_outages, clock, workers),
)
ATTACKS: Final[tuple[Attack, ...]] = tuple(attack for module in _MODULES for attack in module.ATTACKS)


def select(names: Sequence[str]) -> tuple[Attack, ...]:
    """Returns the attacks with these names, or of these kinds, such as `heads`; all of them without names.

    Raises ValueError for an unknown name.
    """
    known = {attack.name for attack in ATTACKS} | {attack.name.partition("/")[0] for attack in ATTACKS}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"{unknown[0]!r} is not an attack; `--list` prints all of them")
    return tuple(
        attack for attack in ATTACKS if not names or attack.name in names or attack.name.partition("/")[0] in names
    )
