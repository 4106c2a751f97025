"""The service's logging: one handler for all loggers, as text or JSON lines, without secrets.

Logging never waits for whoever reads standard error: see BackgroundHandler. Records about a session or a frame name it
with `extra={"session": ..., "seq": ...}`; those of a request have its `request_fields`, too. Records that programs may
look for also have an `event` and its values there: they are fields in JSON, and the message says the same to people.
"""

from __future__ import annotations

import logging
import os
import select
import stat
import sys
import threading
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from contextvars import ContextVar
from http import HTTPStatus
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from pythonjsonlogger.core import RESERVED_ATTRS
from pythonjsonlogger.json import JsonFormatter

if TYPE_CHECKING:
    from lanestream.settings import Settings

# The logger above all loggers of this package.
_OWN: Final = "lanestream"
_NAMES: Final = {"levelname": "level", "name": "logger", "exc_info": "exception", "stack_info": "stack"}
_TIME: Final = "time"
_CONTEXT: Final = ("session", "seq", "request_id", "trace_id")
# Fields that libraries add to their records for their own formatters.
_LIBRARY_FIELDS: Final = ("color_message", "websocket")
# uvicorn's access log. The arguments of its records are the address, method, path, HTTP version and status.
_ACCESS: Final = "uvicorn.access"
_ACCESS_ARGUMENTS: Final = 5
_MOST_PATH_CHARS: Final = 200
_PROBES: Final = frozenset({"/healthz", "/readyz", "/metrics"})
# About 8,000 lines. A limit in bytes, because callers determine the length of some lines.
_QUEUE_BYTES: Final = 1 << 20
# The lines of several processes stay whole in one pipe if no write is longer than this.
_WRITE_BYTES: Final = select.PIPE_BUF
_FLUSH_S: Final = 0.5

# Fields of all records that are logged while a request or a stream is handled.
request_fields: ContextVar[Mapping[str, str]] = ContextVar("request_fields", default=MappingProxyType({}))


class BackgroundHandler(logging.Handler):
    """Writes records to standard error in its own thread, so that a reader that stops reading delays nothing else.

    Lines wait in a queue. Records that do not fit into it are dropped and counted, and a line where they are missing
    says how many.
    """

    def __init__(self) -> None:
        super().__init__()
        self._descriptor = _nonblocking_stderr()
        self._lines: deque[bytes | None] = deque()  # None stands for the line that reports dropped records
        self._queued = 0
        self._dropped = 0
        self._unreported = 0
        self._closed = False
        self._changed = threading.Condition()
        threading.Thread(target=self._work, name="lanestream-log", daemon=True).start()

    @property
    def dropped(self) -> int:
        """The number of records that were dropped."""
        return self._dropped

    def emit(self, record: logging.LogRecord) -> None:
        """Queues a record, formatted here because its arguments may change later."""
        try:
            line = self._line(record)
        except Exception:
            self.handleError(record)
            return
        with self._changed:
            if self._queued + len(line) <= _QUEUE_BYTES:
                self._lines.append(line)
                self._queued += len(line)
                self._changed.notify_all()
                return
            self._dropped += 1
            if not self._unreported:
                self._lines.append(None)
                self._changed.notify_all()
            self._unreported += 1

    def flush(self) -> None:
        """Waits until all queued lines are written, for at most half a second."""
        with self._changed:
            self._changed.wait_for(lambda: not self._lines, _FLUSH_S)

    def close(self) -> None:
        """Ends the thread after it has written the queued lines; does not wait for it."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        super().close()

    def _work(self) -> None:
        while lines := self._next_lines():
            try:
                _write(self._descriptor, b"".join(lines))
                failed = 0
            except OSError:
                failed = len(lines)
            with self._changed:
                for _ in lines:
                    self._queued -= len(self._lines.popleft() or b"")
                self._dropped += failed
                self._changed.notify_all()

    def _next_lines(self) -> list[bytes]:
        """Waits for lines and returns those of the next write, which stay in the queue; none after `close`."""
        lines: list[bytes] = []
        with self._changed:
            self._changed.wait_for(lambda: self._lines or self._closed)
            room = _WRITE_BYTES
            for each in self._lines:
                if lines and (each is None or len(each) > room):
                    break
                lines.append(self._report() if each is None else each)
                room -= len(lines[-1])
        return lines

    def _report(self) -> bytes:
        count, self._unreported = self._unreported, 0
        arguments = ("%d log records were dropped because standard error was not read in time", (count,), None)
        return self._line(logging.LogRecord(__name__, logging.WARNING, __file__, 0, *arguments))

    def _line(self, record: logging.LogRecord) -> bytes:
        return (self.format(record) + "\n").encode(errors="backslashreplace")


class TextLogFormatter(logging.Formatter):
    """Formats records as lines of text: time, level, logger, message, and session, frame, request and trace if any."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)-7s %(name)s: %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  (the library's name)
        """Returns the record as one line, without its traceback."""
        context = {name: getattr(record, name, None) for name in _CONTEXT}
        pairs = [f" {name}={value}" for name, value in context.items() if value is not None]
        return super().formatMessage(record).rstrip() + "".join(pairs)


class JsonLogFormatter(JsonFormatter):
    """Formats each record as a JSON object in one line, with the time first and a traceback as one field."""

    def __init__(self) -> None:
        super().__init__(
            ["levelname", "name", "message"],
            rename_fields=_NAMES,
            defaults={_TIME: None},  # puts the time first
            timestamp=_TIME,
            reserved_attrs=[*RESERVED_ATTRS, *_LIBRARY_FIELDS],
        )

    def add_fields(self, log_data: dict[str, Any], record: logging.LogRecord, message_dict: dict[str, Any]) -> None:
        """Adds the parts of a line of uvicorn's access log as fields."""
        super().add_fields(log_data, record, message_dict)
        if record.name == _ACCESS and isinstance(record.args, tuple) and len(record.args) == _ACCESS_ARGUMENTS:
            address, method, path, _, status = record.args
            log_data |= {"event": "request", "address": address, "method": method, "path": path, "status": status}

    def process_log_record(self, log_data: dict[str, Any]) -> dict[str, Any]:
        """Returns the record without empty fields."""
        return {name: value for name, value in log_data.items() if value is not None}


class RequestFilter(logging.Filter):
    """Adds the fields of the request or stream that is handled to a record, unless the record has its own."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Changes the record in place, and always keeps it."""
        for name, value in request_fields.get().items():
            record.__dict__.setdefault(name, value)
        return True


class QueryRemover(logging.Filter):
    """Removes the query string, which might contain secrets, from every path in a record, and cuts long paths."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Changes the record in place, and always keeps it."""
        if isinstance(record.args, tuple):
            record.args = tuple(_remove_query(each) for each in record.args)
        return True


class FalseAlarmFilter(logging.Filter):
    """Drops an error that uvicorn logs for every properly refused WebSocket (uvicorn issue 3138)."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Returns whether to keep the record."""
        return record.msg != "ASGI callable returned without completing handshake."


class ProbeFilter(logging.Filter):
    """Drops the access log of successful probes, which come every few seconds."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Returns whether to keep the record."""
        if record.name != _ACCESS or not isinstance(record.args, tuple) or len(record.args) != _ACCESS_ARGUMENTS:
            return True
        path, status = record.args[2], record.args[4]
        return path not in _PROBES or status != HTTPStatus.OK


def log_config(settings: Settings) -> dict[str, Any]:
    """Returns the configuration for `logging.config.dictConfig`, by the log level and format of `settings`."""
    level = settings.log_level
    # At debug level libraries log whole requests, including the keys in their headers.
    library_level = "info" if level == "debug" else level
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {"lines": {"()": TextLogFormatter if settings.log_format == "text" else JsonLogFormatter}},
        "filters": {
            "requests": {"()": RequestFilter},
            "queries": {"()": QueryRemover},
            "false_alarms": {"()": FalseAlarmFilter},
            "probes": {"()": ProbeFilter},
        },
        "handlers": {
            "stderr": {
                "()": BackgroundHandler,
                "formatter": "lines",
                "filters": ["requests", "queries", "false_alarms", "probes"],
            },
        },
        "root": {"handlers": ["stderr"], "level": "WARNING"},
        "loggers": {
            _OWN: {"level": level.upper()},
            "uvicorn": {"level": library_level.upper()},
        },
    }


def log_beside_others(settings: Settings) -> None:
    """Logs the service's own records like `log_config`, in a process whose other loggers belong to another program.

    `dictConfig` would close the handlers of that program.
    """
    handler = BackgroundHandler()
    handler.setFormatter(TextLogFormatter() if settings.log_format == "text" else JsonLogFormatter())
    handler.addFilter(QueryRemover())
    logger = logging.getLogger(_OWN)
    logger.addHandler(handler)
    logger.setLevel(settings.log_level.upper())
    logger.propagate = False


def dropped_records() -> int:
    """Returns the number of log records that this process has dropped, because standard error was not read in time."""
    return sum(handler.dropped for handler in _handlers() if isinstance(handler, BackgroundHandler))


def flush_logs() -> None:
    """Waits until queued log records are written, for at most half a second."""
    for handler in _handlers():
        handler.flush()


def _handlers() -> list[logging.Handler]:
    return [*logging.getLogger().handlers, *logging.getLogger(_OWN).handlers]


def _nonblocking_stderr() -> int:
    """Returns the descriptor of standard error, writes to which fail from now on if it is a full pipe.

    Without this, image libraries, which report broken images there, would wait for the reader.
    """
    if sys.__stderr__ is None:  # it was closed before the start, and its number may belong to another file
        return os.open(os.devnull, os.O_WRONLY)
    descriptor = sys.__stderr__.fileno()
    if stat.S_ISFIFO(os.fstat(descriptor).st_mode):
        # The mode of an open pipe belongs to all processes that share it, so this opens the pipe once more. If the
        # system does not allow that, only this handler does not wait.
        with suppress(OSError):
            opened = os.open(f"/proc/self/fd/{descriptor}", os.O_WRONLY | os.O_NONBLOCK)
            os.dup2(opened, descriptor)
            os.close(opened)
    return descriptor


def _write(descriptor: int, data: bytes) -> None:
    """Writes all of `data`, and waits until that is possible."""
    while data:
        try:
            data = data[os.write(descriptor, data) :]
        except BlockingIOError:
            select.select([], [descriptor], [])


def _remove_query(value: object) -> object:
    """Returns a path without its query, cut where a stranger would only fill the log; anything else unchanged."""
    return value.partition("?")[0][:_MOST_PATH_CHARS] if isinstance(value, str) and value.startswith("/") else value
