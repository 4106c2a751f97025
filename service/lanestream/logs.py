"""The service's logging: one handler for all loggers, as text or JSON lines, without secrets.

Records about a session or a frame name it with `extra={"session": ..., "seq": ...}`.
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
# Fields that libraries add to their records for their own formatters.
_LIBRARY_FIELDS: Final = ("color_message", "websocket")
# uvicorn's access log. The arguments of its records are the address, method, path, HTTP version and status.
_ACCESS: Final = "uvicorn.access"
_ACCESS_ARGUMENTS: Final = 5
_PROBES: Final = frozenset({"/healthz", "/readyz", "/metrics"})


class TextLogFormatter(logging.Formatter):
    """Formats records as lines of text: time, level, logger, message, and the session and frame if there are any."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)-7s %(name)s: %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  (the library's name)
        """Returns the record as one line, without its traceback."""
        context = {name: getattr(record, name, None) for name in _CONTEXT}
        pairs = [f" {name}={value}" for name, value in context.items() if value is not None]
        return super().formatMessage(record) + "".join(pairs)


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

    def process_log_record(self, log_data: dict[str, Any]) -> dict[str, Any]:
        """Returns the record without empty fields."""
        return {name: value for name, value in log_data.items() if value is not None}


class QueryRemover(logging.Filter):
    """Removes the query string from every path in a record, because it might contain secrets."""

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
            "queries": {"()": QueryRemover},
            "false_alarms": {"()": FalseAlarmFilter},
            "probes": {"()": ProbeFilter},
        },
        "handlers": {
            "stderr": {
                "class": "logging.StreamHandler",
                "formatter": "lines",
                "filters": ["queries", "false_alarms", "probes"],
            },
        },
        "root": {"handlers": ["stderr"], "level": "WARNING"},
        "loggers": {
            "lanestream": {"level": level.upper()},
            "uvicorn": {"level": library_level.upper()},
        },
    }


def _remove_query(value: object) -> object:
    return value.partition("?")[0] if isinstance(value, str) and value.startswith("/") else value
