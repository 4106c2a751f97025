"""What is kept of a session between two sockets, as bytes of JSON."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, ValidationError

from lanestream.session import SessionState


class SessionRecord(BaseModel):
    """A session at rest: its name, when it began and was saved (wall clock), its state.

    `stream_s` is the time on its stream's own clock and `last_seq` its last frame when it was saved. `clean` tells that
    it was saved after its last frame; without that, frames may have come that this record knows nothing of.
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
        """The record as it is kept."""
        return self.model_dump_json().encode()

    @classmethod
    def of_bytes(cls, data: bytes) -> SessionRecord | None:
        """The record in `data`; None where another version of the product wrote it in a way that is not understood."""
        try:
            return cls.model_validate_json(data)
        except ValidationError:
            return None
