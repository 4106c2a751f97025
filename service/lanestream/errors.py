"""Every error that a user can meet: one root, stable codes, one table from code to HTTP status and close code.

A message says what was wrong; a hint says what is accepted or what to do. Both are one line and safe to show.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

from lanestream.packages import broken_module


class LanestreamError(Exception):
    """The root of all errors that Lanestream raises on purpose.

    `code` is stable and meant for programs. `message` says what was wrong, `hint` what is accepted or what to do. In a
    client, `request_id` is what the log of the service calls the request or stream that failed; None if unknown.
    """

    code: str = "internal"
    request_id: str | None = None

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        request = f" [request {self.request_id}]" if self.request_id else ""
        return (f"{self.message} ({self.hint})" if self.hint else self.message) + request


class ImageError(LanestreamError):
    """The image can't be decoded or violates a limit."""

    code = "bad_image"


class ImageTooLargeError(ImageError):
    """The image has more bytes or pixels than the limits allow."""

    code = "image_too_large"


class ModelError(LanestreamError):
    """A model file can't be loaded or lacks metadata."""

    code = "bad_model"


class ProviderError(LanestreamError):
    """The requested execution provider is not available on this machine."""

    code = "provider_unavailable"


class ProtocolError(LanestreamError):
    """A message or request is malformed, or not allowed at this point of the stream."""

    code = "bad_message"


class NoDetectorError(LanestreamError):
    """The requested detector is not loaded."""

    code = "no_detector"


class OverrunError(LanestreamError):
    """The client exceeded its credits in mode `all`."""

    code = "overrun"


class RateError(LanestreamError):
    """The client exceeded the limit of frames or bytes per second."""

    code = "too_fast"


class ExpiredError(LanestreamError):
    """The frame waited until its lanes were no longer useful, and was dropped before the networks ran."""

    code = "expired"

    def __init__(
        self,
        message: str = "the frame waited too long",
        hint: str = "the service is overloaded: send the frame again, or send fewer frames per second",
    ) -> None:
        super().__init__(message, hint)


class BusyError(LanestreamError):
    """The service or the caller has reached a limit: of sessions, of single images, or of memory for them."""

    code = "busy"


class DrainingError(LanestreamError):
    """The service is about to stop and accepts nothing new."""

    code = "draining"


class UnauthorizedError(LanestreamError):
    """The API key is missing or unknown."""

    code = "unauthorized"


class ForbiddenError(LanestreamError):
    """The origin of the web page is not allowed."""

    code = "forbidden"


class EvictedError(LanestreamError):
    """The session was resumed over another socket."""

    code = "evicted"


class IdleError(LanestreamError):
    """The stream was idle for too long, or the request took too long to arrive."""

    code = "idle"


class TooOldError(LanestreamError):
    """The session reached its maximum age."""

    code = "session_too_old"


class StoreError(LanestreamError):
    """The session store can't be reached. Streams continue, but their sessions can't be resumed elsewhere."""

    code = "store_unavailable"


class LostError(LanestreamError):
    """The answer to a frame was lost with the connection or with the replica."""

    code = "lost"


class WorkerLostError(LanestreamError):
    """The worker process that had the frame crashed, or hung on it. The service starts another process."""

    code = "worker_lost"


class NotReadyError(LanestreamError):
    """The networks are still being loaded, or the worker processes are restarting."""

    code = "not_ready"


class NotAcceptableError(LanestreamError):
    """The response is not available in an accepted media type."""

    code = "not_acceptable"


class SettingsError(LanestreamError):
    """A setting, an environment variable or a command-line option has an invalid value."""

    code = "bad_settings"


class SourceError(LanestreamError):
    """A video source, an image, a folder or another input can't be read, or an output can't be written."""

    code = "bad_source"


class WriteError(SourceError):
    """A file can't be written."""

    code = "write_failed"


class BatchError(LanestreamError):
    """A batch can't start: its folder is in use, or has results of other settings."""

    code = "batch_refused"


class CameraLostError(SourceError):
    """A live camera was lost and did not come back in time."""

    code = "camera_lost"


class ConnectionFailedError(LanestreamError):
    """The client can't reach the service, or lost the connection."""

    code = "connection_failed"


class LabelError(LanestreamError):
    """A label file contains an invalid record."""

    code = "bad_labels"


class CheckpointError(LanestreamError):
    """A checkpoint can't be loaded or does not fit the network."""

    code = "bad_checkpoint"


class ExportError(LanestreamError):
    """An export missed its tolerance and wrote no file."""

    code = "export_failed"


class MissingExtraError(LanestreamError):
    """A feature needs optional packages that are not installed."""

    code = "missing_extra"


@dataclass(frozen=True)
class WireStatus:
    """How an error appears on the wire: as an HTTP status, and as a close code if it ends a WebSocket."""

    http_status: int
    close_code: int


_INTERNAL: Final = WireStatus(500, 1011)
# The errors that a service sends; any other one is sent as `internal`.
_WIRE_STATUS: Final[dict[str, WireStatus]] = {
    ImageError.code: WireStatus(415, 1003),
    ImageTooLargeError.code: WireStatus(413, 1009),
    ProtocolError.code: WireStatus(422, 1002),
    NoDetectorError.code: WireStatus(422, 1008),
    OverrunError.code: WireStatus(429, 1008),
    RateError.code: WireStatus(429, 1008),
    ExpiredError.code: WireStatus(503, 1013),
    BusyError.code: WireStatus(503, 1013),
    DrainingError.code: WireStatus(503, 1012),
    UnauthorizedError.code: WireStatus(401, 1008),
    ForbiddenError.code: WireStatus(403, 1008),
    EvictedError.code: WireStatus(409, 4001),
    IdleError.code: WireStatus(408, 4002),
    TooOldError.code: WireStatus(408, 4003),
    WorkerLostError.code: WireStatus(503, 1013),
    NotReadyError.code: WireStatus(503, 1013),
    NotAcceptableError.code: WireStatus(406, 1003),
}


def wire_status(error: BaseException) -> WireStatus:
    """Returns the HTTP status and close code of `error`; those of `internal` if it has none of its own."""
    return _WIRE_STATUS.get(error.code, _INTERNAL) if isinstance(error, LanestreamError) else _INTERNAL


def documented_errors() -> dict[str, tuple[str, WireStatus]]:
    """Returns the meaning and the wire status of every error that a service sends, by code."""
    meanings = {kind.code: " ".join((kind.__doc__ or "").split()) for kind in _subclasses(LanestreamError)}
    internal = {LanestreamError.code: ("The service failed unexpectedly; its log has the details.", _INTERNAL)}
    return {code: (meanings[code], status) for code, status in _WIRE_STATUS.items()} | internal


def error_from_code(code: str, message: str, hint: str = "") -> LanestreamError:
    """Returns an error of the class with this code; a LanestreamError if the code is unknown."""
    for kind in _subclasses(LanestreamError):
        if kind.code == code:
            return kind(message, hint)
    return LanestreamError(message, hint)


def one_line(text: object, max_chars: int = 200) -> str:
    """Returns `text` on one line of at most `max_chars` characters, for text that may quote untrusted input."""
    return " ".join(str(text).split())[:max_chars]


@contextmanager
def needs_extra(extra: str) -> Iterator[None]:
    """Raises MissingExtraError, which says what to install, if an import in the block fails."""
    try:
        with needs_whole_packages():
            yield
    except ModuleNotFoundError as error:
        raise missing_extra(error, extra) from None


def missing_extra(error: ModuleNotFoundError, extra: str) -> MissingExtraError:
    """Returns the error that says how to install the package that is missing according to `error`."""
    return MissingExtraError(
        f"this needs the package {error.name}, which is not installed", f"pip install 'lanestream[{extra}]'"
    )


@contextmanager
def needs_whole_packages() -> Iterator[None]:
    """Raises MissingExtraError if the block fails because an installed package can't be used.

    A library of the system may be missing, or another package that owns the same module overwrote or removed it.
    """
    try:
        yield
    except ModuleNotFoundError:
        raise
    except (ImportError, AttributeError) as error:
        broken = broken_module(error)
        if broken is None:
            raise
        module, repair = broken
        raise MissingExtraError(f"the package {module} can't be used: {one_line(error)}", repair) from None


def _subclasses(root: type[LanestreamError]) -> Iterator[type[LanestreamError]]:
    for kind in root.__subclasses__():
        yield kind
        yield from _subclasses(kind)
