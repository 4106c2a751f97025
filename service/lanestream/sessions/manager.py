"""Opens and closes the sessions of a process, up to its limit."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lanestream.errors import BusyError

if TYPE_CHECKING:
    from lanestream.engine import Engine
    from lanestream.protocol import DetectorName
    from lanestream.sessions.session import Session


@dataclass(frozen=True)
class OpenSession:
    """A session with the name that its client knows it by."""

    id: str
    session: Session


class SessionManager:
    """The open sessions. Belongs to the event loop: none of its methods waits or is called from another thread."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._open: dict[str, OpenSession] = {}

    def open(self, engine: Engine, horizon: float | None = None, detector: DetectorName | None = None) -> OpenSession:
        """A new session; `horizon` as a share of the image height.

        Raises BusyError at the limit, NoDetectorError where `detector` is not loaded.
        """
        if len(self._open) >= self._limit:
            raise BusyError(f"all {self._limit} sessions are taken", "try again later")
        opened = OpenSession(secrets.token_hex(8), engine.open_session(horizon, detector))
        self._open[opened.id] = opened
        return opened

    def close(self, opened: OpenSession) -> None:
        """Forgets a session."""
        del self._open[opened.id]

    @contextmanager
    def opened(
        self, engine: Engine, horizon: float | None = None, detector: DetectorName | None = None
    ) -> Iterator[OpenSession]:
        """A session for the length of a `with` block."""
        opened = self.open(engine, horizon, detector)
        try:
            yield opened
        finally:
            self.close(opened)
