"""The saved form of a session, as JSON bytes."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, ValidationError

from lanestream.session import SessionState


class SessionRecord(BaseModel):
    """A saved session: its name, the wall-clock times at which it was created and saved, and its state.

    `stream_s` is the stream's own clock and `last_seq` its last answered frame, both at the time of saving. `clean`
    means that the session was saved after its last frame; otherwise, later frames may have been answered that the
    record does not include.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    session: str
    born: float
    saved: float
    stream_s: float
    last_seq: int | None
    clean: bool
    state: SessionState

    def to_bytes(self) -> bytes:
        """Returns the record as JSON."""
        return self.model_dump_json().encode()

    @classmethod
    def from_bytes(cls, data: bytes) -> SessionRecord | None:
        """Returns the record in `data`; None if an incompatible version of the service wrote it."""
        try:
            return cls.model_validate_json(data)
        except ValidationError:
            return None
