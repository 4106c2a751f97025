"""Who is on the other side of a request or a stream."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

ANONYMOUS: Final = "anonymous"


@dataclass(frozen=True)
class Caller:
    """A caller: `identity` owns sessions, `quota` is what their number is counted under.

    With a key both are the key's name. Without one all callers share an identity, and each host has its own quota.
    """

    identity: str
    quota: str
