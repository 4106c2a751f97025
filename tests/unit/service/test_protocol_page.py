"""docs/protocol.md agrees with the code: its examples are valid messages, its tables list the service's codes."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import get_args

import pytest

from lanestream.asyncapi import document
from lanestream.errors import ProtocolError, documented_errors
from lanestream.protocol import (
    MAX_SEQ,
    SUBPROTOCOL,
    WARNINGS,
    BoundaryKind,
    DepartureOptions,
    EgoModel,
    EventModel,
    LaneModel,
    Limits,
    MarkingColor,
    MarkingModel,
    MarkingType,
    parse_client_message,
    parse_server_message,
)
from lanestream.settings import Settings
from lanestream.streaming.stream_protocol import StreamLimits

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "protocol.md").read_text()
EXAMPLES = re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL)


def test_every_message_type_has_an_example() -> None:
    types = [json.loads(example)["type"] for example in EXAMPLES]
    assert set(types) == set(document()["components"]["messages"]) - {"image", "end"}
    assert '`{"type": "end"}`' in PAGE


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: json.loads(example)["type"])
def test_an_example_is_a_valid_message(example: str) -> None:
    try:
        parse_client_message(example)
    except ProtocolError:
        parse_server_message(example)


def test_the_table_of_errors_is_complete() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (\d+) \| (\d+) \| (.*) \|$", PAGE, re.MULTILINE)
    errors = [
        (code, str(status.close_code), str(status.http_status), meaning)
        for code, (meaning, status) in documented_errors().items()
    ]
    assert rows == errors


def test_the_table_of_close_codes_agrees_with_asyncapi() -> None:
    rows = dict(re.findall(r"^\| (\d+) \| (.*) \|$", PAGE, re.MULTILINE))
    closes = document()["channels"]["stream"]["x-close-codes"]
    assert {code: rows[code].replace("`max_bytes`", "the size limit of an image") for code in closes} == closes


def rows(header: str) -> dict[str, list[str]]:
    """Returns the rows of the table with this header: the other cells by the name in the first."""
    lines = PAGE.split(f"\n{header}\n")[1].split("\n\n")[0].splitlines()[1:]
    cells = [line.strip("| ").split(" | ") for line in lines]
    return {first.strip("`"): rest for first, *rest in cells}


def test_the_tables_of_results_are_complete() -> None:
    assert set(rows("| state | |")) == set(get_args(LaneModel.model_fields["state"].annotation))
    ego = {name for name in EgoModel.model_fields if not name.endswith("_sigma")}
    assert set(rows("| field | | needs |")) == ego - {"left", "right", "left_kind", "right_kind"}
    what = rows("| field of a lane | |")
    lane = set(LaneModel.model_fields) - {"marking"}
    assert set(what) == lane | {f"marking.{name}" for name in MarkingModel.model_fields}
    for name, values in (("kind", BoundaryKind), ("marking.type", MarkingType), ("marking.color", MarkingColor)):
        assert set(get_args(values)) <= set(re.findall(r"`(\w+)`", what[name][0]))
    assert {f"{name}_sigma" for name in rows("| field | | needs |")} <= set(EgoModel.model_fields)
    events = {
        event.model_fields["type"].default: set(event.model_fields) - {"type", "timestamp"}
        for event in get_args(EventModel)
    }
    described = {
        name: set(re.findall(r"`(\w+)`", fields)) for name, (fields, *_) in rows("| event | fields | |").items()
    }
    assert described == events


def test_every_field_is_described() -> None:
    fields = {
        f"{name}.{field}": schema
        for name, message in document()["components"]["schemas"].items()
        for field, schema in message["properties"].items()
    }
    parts = {name: [schema, *schema.get("anyOf", [])] for name, schema in fields.items() if not name.endswith(".type")}
    assert [
        name for name, found in parts.items() if not any({"description", "$ref"} & set(each) for each in found)
    ] == []


def test_the_tables_of_warnings_and_departures_are_complete() -> None:
    warnings = {code: meaning.split(";")[0] for code, (meaning,) in rows("| code | |").items()}
    assert warnings == {code: message for code, (message, _) in WARNINGS.items()}
    options = {name: float(default) for name, (default, _) in rows("| field | default | |").items()}
    assert options == asdict(Settings().departure_settings)
    assert set(options) == set(DepartureOptions.model_fields)


def test_the_numbers_are_the_defaults() -> None:
    settings, limits = Settings(), StreamLimits()
    (ready,) = [json.loads(example) for example in EXAMPLES if '"ready"' in example]
    assert ready["limits"] == {name: getattr(settings, name) for name in Limits.model_fields}
    assert settings.handshake_s == 10.0
    assert "within 10 seconds" in PAGE
    assert (limits.frame_deadline_s, limits.burst_s) == (2.0, 2.0)
    assert MAX_SEQ == 2**53 - 1
    assert f"`{SUBPROTOCOL}`" in PAGE


def test_the_five_lines_are_the_same_in_the_readme() -> None:
    (lines,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert lines in (ROOT / "README.md").read_text()
