"""How the service logs: one handler for all, lines for people or JSON for machines, and no secrets.

A record that concerns a session or a frame says so by `extra={"session": ..., "seq": ...}`.
"""

from __future__ import annotations

import logging
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Final

from pythonjsonlogger.core import RESERVED_ATTRS
from pythonjsonlogger.json import JsonFormatter

if TYPE_CHECKING:
    from lanestream.settings import Settings

_NAMES: Final = {"levelname": "level", "name": "logger", "exc_info": "exception", "stack_info": "stack"}
_TIME: Final = "time"
_CONTEXT: Final = ("session", "seq")
# What libraries add to their records, for their own formatters.
_OF_LIBRARIES: Final = ("color_message", "websocket")
# uvicorn's records of requests: address, method, path, version and status.
_ACCESS: Final = "uvicorn.access"
_ACCESS_ARGUMENTS: Final = 5
_PROBES: Final = frozenset({"/healthz", "/readyz", "/metrics"})


class TextFormatter(logging.Formatter):
    """Lines for people: when, how grave, who, what, and the session and the frame that it concerns."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)-7s %(name)s: %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  (the library's name)
        """The record in one line, without its traceback."""
        context = {name: getattr(record, name, None) for name in _CONTEXT}
        told = [f" {name}={value}" for name, value in context.items() if value is not None]
        return super().formatMessage(record) + "".join(told)


class JsonLines(JsonFormatter):
    """One JSON object a line for machines, with the time first; a traceback is one field of it."""

    def __init__(self) -> None:
        super().__init__(
            ["levelname", "name", "message"],
            rename_fields=_NAMES,
            defaults={_TIME: None},  # which keeps the first place for it
            timestamp=_TIME,
            reserved_attrs=[*RESERVED_ATTRS, *_OF_LIBRARIES],
        )

    def process_log_record(self, log_data: dict[str, Any]) -> dict[str, Any]:
        """The record without what does not concern it."""
        return {name: value for name, value in log_data.items() if value is not None}


class WithoutQueries(logging.Filter):
    """Cuts off the query of every path that is logged: it is not needed, and might have what is nobody's business."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Changes the record in place, and keeps it."""
        if isinstance(record.args, tuple):
            record.args = tuple(_without_query(each) for each in record.args)
        return True


class WithoutFalseAlarms(logging.Filter):
    """Drops an error that uvicorn reports of every WebSocket that was refused properly (uvicorn's issue 3138)."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is kept."""
        return record.msg != "ASGI callable returned without completing handshake."


class WithoutProbes(logging.Filter):
    """Drops the lines about probes that went well: they come every few seconds and tell nothing."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is kept."""
        if record.name != _ACCESS or not isinstance(record.args, tuple) or len(record.args) != _ACCESS_ARGUMENTS:
            return True
        path, status = record.args[2], record.args[4]
        return path not in _PROBES or status != HTTPStatus.OK


def log_config(settings: Settings) -> dict[str, Any]:
    """The configuration, for `logging.config.dictConfig`, that `settings` ask for."""
    level = settings.log_level
    # What libraries tell at the level debug has whole requests in it, with the keys in their headers.
    level_of_libraries = "info" if level == "debug" else level
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {"lines": {"()": TextFormatter if settings.log_format == "text" else JsonLines}},
        "filters": {
            "queries": {"()": WithoutQueries},
            "alarms": {"()": WithoutFalseAlarms},
            "probes": {"()": WithoutProbes},
        },
        "handlers": {
            "stderr": {
                "class": "logging.StreamHandler",
                "formatter": "lines",
                "filters": ["queries", "alarms", "probes"],
            },
        },
        "root": {"handlers": ["stderr"], "level": "WARNING"},
        "loggers": {
            "lanestream": {"level": level.upper()},
            "uvicorn": {"level": level_of_libraries.upper()},
        },
    }


def _without_query(value: object) -> object:
    return value.partition("?")[0] if isinstance(value, str) and value.startswith("/") else value
