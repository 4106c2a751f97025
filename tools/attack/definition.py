"""What an attack is: a function, the settings that the service gets, and what must hold."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from attack.target import Target


class UnexpectedError(Exception):
    """The service did something else than the attack expects, for example it kept a connection that it must close."""


# Attacks `target` with `count` connections, sessions or requests until the monotonic time `stop_at`.
# Raises UnexpectedError.
Run = Callable[[Target, float, int], Coroutine[Any, Any, None]]
# Returns what the attack sends, if it takes time to find that out: `payload` of the target that `run` gets.
Prepare = Callable[[Target], Coroutine[Any, Any, bytes]]
# Starts what the service needs, in a folder of its own, and yields environment variables for the service.
Surroundings = Callable[[Path], AbstractContextManager[Mapping[str, str]]]


def nothing(_: Path) -> AbstractContextManager[Mapping[str, str]]:
    """The surroundings of a service that needs nothing else."""
    return nullcontext({})


async def no_payload(_: Target) -> bytes:
    """What most attacks need."""
    return b""


@dataclass(frozen=True)
class Attack:
    """An attack, with what the service needs for it and what a normal camera may feel.

    `count` is the number that `run` gets, `short_count` the one for `--short`; the attack takes `seconds` or
    `short_seconds`. `settings` are settings of the service. `cameras` normal cameras are observed; if `fair`, they must
    get most of the answers that they get without the attack. The worst latency of a normal camera may be `worst_s`
    seconds, and nobody may be locked out for `lockout_s` seconds. With `unread_log`, nobody reads the service's log.
    """

    name: str
    description: str
    run: Run
    count: int = 1
    short_count: int = 1
    seconds: float = 10.0
    short_seconds: float = 3.0
    prepare: Prepare = no_payload
    settings: Mapping[str, object] = field(default_factory=dict)
    surroundings: Surroundings = nothing
    cameras: int = 1
    fair: bool = False
    worst_s: float = 1.0
    lockout_s: float = 2.0
    unread_log: bool = False
