"""Log records as text and as JSON, and how they are written: to real pipes, by real processes."""

from __future__ import annotations

import json
import logging
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import IO

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
    long = record("%s", "/" + "x" * 8000)
    assert QueryRemover().filter(long)
    assert len(long.getMessage()) == 200
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


# A process that runs for longer than this is waiting for somebody to read its log.
HANG_S = 30.0
# A process that logs as the service and its workers do. `program` is appended.
LOGGING = """
import logging.config, os, signal, sys
from lanestream.logs import dropped_records, flush_logs, log_config
from lanestream.settings import Settings
logging.config.dictConfig(log_config(Settings()))
log = logging.getLogger("lanestream.test").info
def log_lines(first, last):
    for number in range(first, last):
        log("line %d", number)
"""


@contextmanager
def logging_process(program: str, stderr: int | IO[bytes] = subprocess.PIPE) -> Iterator[subprocess.Popen[bytes]]:
    """Starts a process that logs, and kills it if it hangs. Nobody reads its standard error unless the test does."""
    command = [sys.executable, "-c", LOGGING + program]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr) as process:
        timer = threading.Timer(HANG_S, process.kill)
        timer.start()
        try:
            yield process
        finally:
            timer.cancel()
            process.kill()


def stdout_line(process: subprocess.Popen[bytes]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().decode().rstrip()


def numbers(lines: list[str]) -> list[int]:
    """Returns the number of each line; fails if one is not whole."""
    matches = [re.fullmatch(r"[\d-]+ [\d:,]+ INFO    lanestream\.test: line (\d+)", line) for line in lines]
    return [int(match[1]) for match in matches if match is not None] if all(matches) else pytest.fail(str(lines))


def test_a_process_goes_on_and_ends_if_nobody_reads_its_log() -> None:
    with logging_process("log_lines(0, 100_000); print(dropped_records(), flush=True)") as process:
        dropped = int(stdout_line(process))
        assert process.wait() == 0
        assert process.stderr is not None
        written = process.stderr.read().decode()
    found = numbers(written.splitlines())
    assert written.endswith("\n")
    assert found == list(range(len(found)))
    assert 0 < dropped < 100_000


def test_a_line_says_how_many_records_are_missing_where_they_are_missing() -> None:
    fill = "log_lines(0, 2_000); flush_logs(); log_lines(2_000, 50_000); print(dropped_records(), flush=True)"
    with logging_process(f"{fill}; input(); log_lines(50_000, 50_100)") as process:
        dropped = int(stdout_line(process))
        kept = 50_000 - dropped
        assert process.stdin is not None
        assert process.stderr is not None
        lines = [process.stderr.readline().decode().rstrip() for _ in range(kept + 1)]
        process.stdin.write(b"\n")
        process.stdin.flush()
        lines += process.stderr.read().decode().splitlines()
    assert numbers(lines[:kept]) == list(range(kept))
    message = f"WARNING lanestream.logs: {dropped} log records were dropped because standard error was not read in time"
    assert lines[kept].endswith(message)
    assert numbers(lines[kept + 1 :]) == list(range(50_000, 50_100))


def test_no_record_is_lost_if_somebody_reads() -> None:
    with logging_process("log_lines(0, 5_000); print(dropped_records())") as process:
        stdout, stderr = process.communicate()
    assert stdout == b"0\n"
    assert numbers(stderr.decode().splitlines()) == list(range(5_000))


def test_flushing_writes_everything_before_a_signal_ends_the_process() -> None:
    with logging_process("log_lines(0, 2_000); flush_logs(); signal.raise_signal(signal.SIGTERM)") as process:
        _, stderr = process.communicate()
        assert process.returncode == -signal.SIGTERM
    assert numbers(stderr.decode().splitlines()) == list(range(2_000))


def test_image_libraries_do_not_wait_for_the_reader_of_the_log() -> None:
    program = """
import cv2, numpy
image = bytearray(cv2.imencode(".png", numpy.zeros((50, 50, 3), numpy.uint8))[1])
image[50] ^= 255
for _ in range(5_000):
    assert cv2.imdecode(numpy.frombuffer(image, numpy.uint8), cv2.IMREAD_COLOR) is None
print("done", flush=True)
"""
    with logging_process(program) as process:
        assert process.wait() == 0
        assert process.stderr is not None
        assert process.stderr.read().startswith(b"libpng error")


def test_a_file_keeps_what_is_in_it(tmp_path: Path) -> None:
    path = tmp_path / "log"
    with path.open("wb", buffering=0) as file:
        file.write(b"before\n")
        with logging_process("log_lines(0, 1)", stderr=file) as process:
            process.wait()
        file.write(b"after\n")
    first, *between, last = path.read_text().splitlines()
    assert (first, numbers(between), last) == ("before", [0], "after")


def test_no_record_gets_into_another_file_if_standard_error_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "file"
    # The first file that the process opens gets the number of standard error.
    opening = f"import os; print(os.open({str(path)!r}, os.O_WRONLY | os.O_CREAT))"
    program = f"{opening}\n{LOGGING}\nlog_lines(0, 3)"
    command = ["sh", "-c", 'exec "$0" -c "$1" 2>&-', sys.executable, program]
    assert subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout == b"2\n"
    assert path.read_bytes() == b""


def test_an_error_of_the_file_is_not_an_error_of_the_caller() -> None:
    with logging_process("os.close(2); log_lines(0, 3); flush_logs(); print(dropped_records())") as process:
        stdout, _ = process.communicate()
        assert (process.returncode, stdout) == (0, b"3\n")


def test_the_parts_of_an_access_are_fields_and_have_no_query() -> None:
    logger = logging.getLogger("uvicorn.access")
    arguments = ("127.0.0.1:5", "GET", "/v1/models?key=secret", "1.1", 401)
    access = logger.makeRecord(logger.name, logging.INFO, "x.py", 1, '%s - "%s %s HTTP/%s" %d', arguments, None)
    QueryRemover().filter(access)
    fields = json.loads(JsonLogFormatter().format(access))
    assert {name: fields[name] for name in ("event", "address", "method", "path", "status")} == {
        "event": "request",
        "address": "127.0.0.1:5",
        "method": "GET",
        "path": "/v1/models",
        "status": 401,
    }
    assert "secret" not in str(fields)
