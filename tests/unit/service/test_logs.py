"""Log records as lines for people and as JSON."""

from __future__ import annotations

import json
import logging
import sys
from datetime import datetime

import pytest

from lanestream.logs import JsonLines, TextFormatter, WithoutFalseAlarms, WithoutProbes, WithoutQueries, log_config
from lanestream.settings import Settings


def record(message: str, *args: object, **extra: object) -> logging.LogRecord:
    logger = logging.getLogger("lanestream.test")
    return logger.makeRecord(logger.name, logging.WARNING, "x.py", 1, message, args, None, extra=extra)


def failed() -> logging.LogRecord:
    found = record("it failed", session="abc", seq=3)
    try:
        raise ValueError("why")
    except ValueError:
        found.exc_info = sys.exc_info()
    return found


def test_json_has_what_happened_when_where_and_to_whom() -> None:
    told = json.loads(JsonLines().format(record("frame %s", 3, session="abc", seq=3, color_message="x")))
    time = datetime.fromisoformat(told.pop("time"))
    assert time.tzinfo is not None
    assert list(told.items()) == [
        ("level", "WARNING"),
        ("logger", "lanestream.test"),
        ("message", "frame 3"),
        ("session", "abc"),
        ("seq", 3),
    ]


def test_an_exception_is_one_field_of_one_line() -> None:
    line = JsonLines().format(failed())
    assert "\n" not in line
    told = json.loads(line)
    assert told["message"] == "it failed"
    assert told["exception"].endswith("ValueError: why")
    assert "Traceback" in told["exception"]


def test_text_has_the_same() -> None:
    first, *rest = TextFormatter().format(failed()).splitlines()
    assert first.endswith(" WARNING lanestream.test: it failed session=abc seq=3")
    assert rest[-1] == "ValueError: why"
    for nothing in ({}, {"session": None, "seq": None}):
        assert TextFormatter().format(record("hello", **nothing)).endswith(" WARNING lanestream.test: hello")
        assert set(json.loads(JsonLines().format(record("hello", **nothing)))) == {"time", "level", "logger", "message"}


def test_queries_are_cut_off() -> None:
    found = record('%s - "%s %s HTTP/%s" %d', "127.0.0.1:1", "GET", "/v1/models?key=secret", "1.1", 200)
    assert WithoutQueries().filter(found)
    assert found.getMessage() == '127.0.0.1:1 - "GET /v1/models HTTP/1.1" 200'
    other = record("what?")
    assert WithoutQueries().filter(other)
    assert other.getMessage() == "what?"


def test_only_the_false_alarm_is_dropped() -> None:
    assert not WithoutFalseAlarms().filter(record("ASGI callable returned without completing handshake."))
    assert WithoutFalseAlarms().filter(record("ASGI callable should return None, but returned '%s'.", 1))


def test_only_probes_that_went_well_are_not_told() -> None:
    def kept(path: str, status: int) -> bool:
        found = record('%s - "%s %s HTTP/%s" %d', "127.0.0.1:1", "GET", path, "1.1", status)
        found.name = "uvicorn.access"
        return WithoutProbes().filter(found)

    assert [kept(*each) for each in (("/readyz", 200), ("/readyz", 503), ("/v1/models", 200))] == [False, True, True]
    assert WithoutProbes().filter(record("ready"))


@pytest.mark.parametrize(
    ("level", "ours", "theirs"), [("debug", "DEBUG", "INFO"), ("info", "INFO", "INFO"), ("error", "ERROR", "ERROR")]
)
def test_libraries_never_tell_whole_requests(level: str, ours: str, theirs: str) -> None:
    loggers = log_config(Settings(log_level=level))["loggers"]
    assert (loggers["lanestream"]["level"], loggers["uvicorn"]["level"]) == (ours, theirs)
