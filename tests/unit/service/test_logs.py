"""Log records as text and as JSON."""

from __future__ import annotations

import json
import logging
import sys
from datetime import datetime

import pytest

from lanestream.logs import FalseAlarmFilter, JsonLogFormatter, ProbeFilter, QueryRemover, TextLogFormatter, log_config
from lanestream.settings import Settings


def record(message: str, *args: object, **extra: object) -> logging.LogRecord:
    logger = logging.getLogger("lanestream.test")
    return logger.makeRecord(logger.name, logging.WARNING, "x.py", 1, message, args, None, extra=extra)


def record_with_exception() -> logging.LogRecord:
    found = record("it failed", session="abc", seq=3)
    try:
        raise ValueError("why")
    except ValueError:
        found.exc_info = sys.exc_info()
    return found


def test_json_has_time_level_logger_message_and_context() -> None:
    fields = json.loads(JsonLogFormatter().format(record("frame %s", 3, session="abc", seq=3, color_message="x")))
    time = datetime.fromisoformat(fields.pop("time"))
    assert time.tzinfo is not None
    assert list(fields.items()) == [
        ("level", "WARNING"),
        ("logger", "lanestream.test"),
        ("message", "frame 3"),
        ("session", "abc"),
        ("seq", 3),
    ]


def test_an_exception_is_one_field_of_one_line() -> None:
    line = JsonLogFormatter().format(record_with_exception())
    assert "\n" not in line
    fields = json.loads(line)
    assert fields["message"] == "it failed"
    assert fields["exception"].endswith("ValueError: why")
    assert "Traceback" in fields["exception"]


def test_text_has_the_context_and_the_traceback() -> None:
    first, *rest = TextLogFormatter().format(record_with_exception()).splitlines()
    assert first.endswith(" WARNING lanestream.test: it failed session=abc seq=3")
    assert rest[-1] == "ValueError: why"
    for empty in ({}, {"session": None, "seq": None}):
        assert TextLogFormatter().format(record("hello", **empty)).endswith(" WARNING lanestream.test: hello")
        assert set(json.loads(JsonLogFormatter().format(record("hello", **empty)))) == {
            "time",
            "level",
            "logger",
            "message",
        }


def test_queries_are_removed() -> None:
    found = record('%s - "%s %s HTTP/%s" %d', "127.0.0.1:1", "GET", "/v1/models?key=secret", "1.1", 200)
    assert QueryRemover().filter(found)
    assert found.getMessage() == '127.0.0.1:1 - "GET /v1/models HTTP/1.1" 200'
    other = record("what?")
    assert QueryRemover().filter(other)
    assert other.getMessage() == "what?"


def test_only_the_false_alarm_is_dropped() -> None:
    assert not FalseAlarmFilter().filter(record("ASGI callable returned without completing handshake."))
    assert FalseAlarmFilter().filter(record("ASGI callable should return None, but returned '%s'.", 1))


def test_only_successful_probes_are_dropped() -> None:
    def kept(path: str, status: int) -> bool:
        found = record('%s - "%s %s HTTP/%s" %d', "127.0.0.1:1", "GET", path, "1.1", status)
        found.name = "uvicorn.access"
        return ProbeFilter().filter(found)

    assert [kept(*each) for each in (("/readyz", 200), ("/readyz", 503), ("/v1/models", 200))] == [False, True, True]
    assert ProbeFilter().filter(record("ready"))


@pytest.mark.parametrize(
    ("level", "own", "libraries"), [("debug", "DEBUG", "INFO"), ("info", "INFO", "INFO"), ("error", "ERROR", "ERROR")]
)
def test_libraries_never_log_at_debug_level(level: str, own: str, libraries: str) -> None:
    loggers = log_config(Settings(log_level=level))["loggers"]
    assert (loggers["lanestream"]["level"], loggers["uvicorn"]["level"]) == (own, libraries)
