"""The saved form of a session, as JSON bytes."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lanestream.protocol import MAX_SEQ, SessionName
from lanestream.session import SessionState

# Records have a few kilobytes. Reading a far larger one would block the event loop.
_MOST_BYTES: Final = 1 << 18


class SessionRecord(BaseModel):
    """A saved session: its name, its state and its clocks at the time of saving.

    `age_s` is the session's age, `stream_s` the stream's own clock, and `last_seq` the last answered frame. It was
    saved at the time of day `saved_s`, when the monotonic clock of the process `process` was at `clock_s`. `clean`
    means that it was saved after its last frame; otherwise, later frames may have been answered that the record does
    not include.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    session: SessionName
    process: str
    clock_s: float
    saved_s: float
    age_s: Annotated[float, Field(ge=0.0)]
    stream_s: Annotated[float, Field(ge=0.0, le=1e15)]
    last_seq: Annotated[int, Field(ge=0, le=MAX_SEQ)] | None
    clean: bool
    state: SessionState

    def to_bytes(self) -> bytes:
        """Returns the record as JSON."""
        return self.model_dump_json().encode()

    @classmethod
    def from_bytes(cls, data: bytes) -> SessionRecord | None:
        """Returns the record in `data`; None if it is not one of this version. Its state may still be invalid."""
        if len(data) > _MOST_BYTES:
            return None
        try:
            return cls.model_validate_json(data)
        except ValidationError:
            return None
