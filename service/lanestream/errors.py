"""Every error that a user can meet: one root, stable codes, one table from code to HTTP status and close code.

A message says what was wrong; a hint says what is accepted or what to do. Both are one line and safe to show.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final


class LanestreamError(Exception):
    """The root of all errors that Lanestream raises on purpose.

    `code` is stable and meant for programs, `message` says what was wrong, `hint` what is accepted or what to do.
    """

    code: str = "internal"

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.message} ({self.hint})" if self.hint else self.message


class ImageError(LanestreamError):
    """A frame that can't be decoded or is outside the limits."""

    code = "bad_image"


class ImageTooLargeError(ImageError):
    """A frame with more bytes or more pixels than the limits allow."""

    code = "image_too_large"


class ModelError(LanestreamError):
    """A model file that can't be loaded or does not describe itself."""

    code = "bad_model"


class ProviderError(LanestreamError):
    """An execution provider was required and can't be had on this machine."""

    code = "provider_unavailable"


class ProtocolError(LanestreamError):
    """A stream message that is malformed or arrives where it is not allowed."""

    code = "bad_message"


class NoDetectorError(LanestreamError):
    """A detector was asked for whose network this process has not loaded."""

    code = "no_detector"


class OverrunError(LanestreamError):
    """A client sent more frames than it was granted in mode `all`."""

    code = "overrun"


class RateError(LanestreamError):
    """A client sent more frames or bytes a second than a session may."""

    code = "too_fast"


class ExpiredError(LanestreamError):
    """A frame waited so long that its lanes would be of no use; it was dropped before the networks ran."""

    code = "expired"

    def __init__(
        self,
        message: str = "the frame waited too long",
        hint: str = "the service is busy: send it again, or fewer frames a second",
    ) -> None:
        super().__init__(message, hint)


class BusyError(LanestreamError):
    """The service, or one caller, is at the session limit."""

    code = "busy"


class DrainingError(LanestreamError):
    """The service is about to stop and takes nothing new."""

    code = "draining"


class UnauthorizedError(LanestreamError):
    """A caller without a key, or with a wrong one."""

    code = "unauthorized"


class ForbiddenError(LanestreamError):
    """A caller from a web page whose origin is not among the allowed ones."""

    code = "forbidden"


class EvictedError(LanestreamError):
    """The session goes on over another socket, so that this one has to go."""

    code = "evicted"


class IdleError(LanestreamError):
    """Nothing came over a stream for too long, or not all of a request."""

    code = "idle"


class TooOldError(LanestreamError):
    """A session reached its longest life."""

    code = "session_too_old"


class StoreError(LanestreamError):
    """The store of sessions can't be reached; streams go on, but can't be resumed elsewhere meanwhile."""

    code = "store_unavailable"


class LostError(LanestreamError):
    """A frame whose answer was lost with the connection, or with the replica that had it."""

    code = "lost"


class WorkerLostError(LanestreamError):
    """The process that worked on a frame has ended, and the frame is lost; the service starts another process."""

    code = "worker_lost"


class NotReadyError(LanestreamError):
    """The service has not loaded its network yet."""

    code = "not_ready"


class NotAcceptableError(LanestreamError):
    """A request for an answer in a form that the service does not speak."""

    code = "not_acceptable"


class SettingsError(LanestreamError):
    """A setting, or a command line, with a value that is not accepted."""

    code = "bad_settings"


class SourceError(LanestreamError):
    """A video source, an image or a folder that can't be read, or a sink that can't be written."""

    code = "bad_source"


class ConnectionFailedError(LanestreamError):
    """The client can't reach the service, or lost it."""

    code = "connection_failed"


class LabelError(LanestreamError):
    """A label file with a record that can't be used."""

    code = "bad_labels"


class CheckpointError(LanestreamError):
    """A checkpoint that can't be loaded, or that does not fit the network."""

    code = "bad_checkpoint"


class ExportError(LanestreamError):
    """An export that missed its tolerance; no file is left behind."""

    code = "export_failed"


class MissingExtraError(LanestreamError):
    """A feature whose optional packages are not installed."""

    code = "missing_extra"


@dataclass(frozen=True)
class Answer:
    """How an error is told: the HTTP status, and the WebSocket close code where it ends the stream."""

    http_status: int
    close_code: int


_INTERNAL: Final = Answer(500, 1011)
_ANSWERS: Final[dict[str, Answer]] = {
    ImageError.code: Answer(415, 1003),
    ImageTooLargeError.code: Answer(413, 1009),
    ProtocolError.code: Answer(422, 1002),
    NoDetectorError.code: Answer(422, 1008),
    OverrunError.code: Answer(429, 1008),
    RateError.code: Answer(429, 1008),
    ExpiredError.code: Answer(503, 1013),
    BusyError.code: Answer(503, 1013),
    DrainingError.code: Answer(503, 1012),
    UnauthorizedError.code: Answer(401, 1008),
    ForbiddenError.code: Answer(403, 1008),
    EvictedError.code: Answer(409, 4001),
    IdleError.code: Answer(408, 4002),
    TooOldError.code: Answer(408, 4003),
    WorkerLostError.code: Answer(503, 1013),
    NotReadyError.code: Answer(503, 1013),
    NotAcceptableError.code: Answer(406, 1003),
}


def answer_to(error: BaseException) -> Answer:
    """How `error` is answered over HTTP and over a WebSocket."""
    return _ANSWERS.get(error.code, _INTERNAL) if isinstance(error, LanestreamError) else _INTERNAL


def told_errors() -> dict[str, tuple[str, Answer]]:
    """What each error that a service tells means, and how it is answered, by its code."""
    meanings = {kind.code: " ".join((kind.__doc__ or "").split()) for kind in _kinds(LanestreamError)}
    own = {LanestreamError.code: ("A mistake of the service's own; its log tells more.", _INTERNAL)}
    return {code: (meanings[code], answer) for code, answer in _ANSWERS.items()} | own


def error_of(code: str, message: str, hint: str = "") -> LanestreamError:
    """The error that the service told as `code`, of the class that has this code; of the root where none has."""
    for kind in _kinds(LanestreamError):
        if kind.code == code:
            return kind(message, hint)
    return LanestreamError(message, hint)


def _kinds(root: type[LanestreamError]) -> Iterator[type[LanestreamError]]:
    for kind in root.__subclasses__():
        yield kind
        yield from _kinds(kind)


def one_line(told: object, most: int = 200) -> str:
    """What an error or a text says, in one line of `most` characters, whoever had a part in its wording."""
    return " ".join(str(told).split())[:most]


@contextmanager
def needs_extra(extra: str) -> Iterator[None]:
    """Imports in the block need the optional packages `extra`; MissingExtraError says how to get them."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"this needs the package {error.name}, which is not installed", f"pip install 'lanestream[{extra}]'"
        ) from None
