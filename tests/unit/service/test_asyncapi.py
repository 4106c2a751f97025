"""The AsyncAPI document says what the models say, and docs/asyncapi.yaml says the same."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fakes
import jsonschema_rs
import pytest
import yaml

from lanestream.asyncapi import document
from lanestream.protocol import (
    CameraModel,
    DrainingMessage,
    EgoModel,
    EndMessage,
    ErrorMessage,
    FrameMessage,
    LaneChangeModel,
    LaneModel,
    LanesMessage,
    LineModel,
    Message,
    StartMessage,
    SummaryMessage,
    TimingModel,
    schemas,
)

ROOT = Path(__file__).parents[3]
FILE = ROOT / "docs" / "asyncapi.yaml"

LANE = LaneModel(
    track_id=3,
    position=-1,
    state="detected",
    probability=0.9,
    points=[(1.0, 2.0), (3.0, 1.0)],
    line=LineModel(bottom=(1.0, 2.0), top=(3.0, 1.0)),
    horizon=0.5,
    coefficients=(1.0, 2.0, 3.0),
    covariance=[[1.0] * 3] * 3,
    age_s=0.1,
    ground=(0.0, 0.1, 1.8),
)
LANES = LanesMessage(
    seq=1,
    timestamp=0.04,
    width=320,
    height=180,
    horizon=72.0,
    lanes=[LANE],
    ego=EgoModel(left=3, right=None, offset=None),
    events=[LaneChangeModel(track_id=3, direction="left")],
    dropped=0,
    timing_ms=TimingModel(decode=1, propose=1, queue=1, infer=1, track=1, total=5),
)
MESSAGES: list[Message] = [
    StartMessage(mode="all", camera=CameraModel(height=1.4, field_of_view=62.0)),
    FrameMessage(seq=7, timestamp=-0.5),
    EndMessage(),
    fakes.ready(),
    LANES,
    ErrorMessage(code="bad_image", message="m"),
    DrainingMessage(resume_token=None, deadline_s=10.0),
    SummaryMessage(frames=1, answered=1, failed=0, dropped=0, duration_s=1.0),
]


def objects(value: Any) -> Iterator[dict[str, Any]]:
    """Every object in a document, at any depth."""
    if isinstance(value, dict):
        yield value
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from objects(inner)


def at(pointer: str) -> Any:
    found: Any = document()
    for name in pointer.removeprefix("#/").split("/"):
        found = found[name]
    return found


def payload_validator(name: str) -> jsonschema_rs.Draft7Validator:
    """What checks messages of a type, with all the document's schemas at hand."""
    payload = document()["components"]["messages"][name]["payload"]
    return jsonschema_rs.Draft7Validator({**payload, "components": document()["components"]})


def test_the_file_is_what_the_models_say() -> None:
    spec = importlib.util.spec_from_file_location("asyncapi", ROOT / "tools" / "asyncapi.py")
    assert spec is not None
    assert spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    assert FILE.read_text() == tool.document_yaml(), "make asyncapi"
    assert yaml.safe_load(FILE.read_text()) == document()


def test_every_reference_leads_somewhere() -> None:
    references = [each["$ref"] for each in objects(document()) if "$ref" in each]
    assert len(references) > 30
    for reference in references:
        assert isinstance(at(reference), dict)


def test_every_message_of_the_protocol_is_told_and_no_other() -> None:
    told = {each["name"] for each in document()["components"]["messages"].values()}
    spoken = {
        name.removesuffix("Message").lower()
        for side in schemas().values()
        for name in side["$defs"]
        if name.endswith("Message")
    }
    assert told == spoken | {"image"}
    in_use = {
        reference["$ref"].rpartition("/")[2]
        for operation in document()["operations"].values()
        for reference in [*operation["messages"], *operation.get("reply", {}).get("messages", [])]
    }
    assert in_use == told


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.type)
def test_the_schemas_take_our_messages_and_refuse_others(message: Any) -> None:
    validator = payload_validator(message.type)
    value = json.loads(message.model_dump_json())
    validator.validate(value)
    assert not validator.is_valid({**value, "more": 1})
    assert not validator.is_valid({**value, "type": "other"})


def test_the_examples_are_messages() -> None:
    messages = document()["components"]["messages"]
    examples = [(name, each["payload"]) for name, told in messages.items() for each in told.get("examples", ())]
    assert len(examples) >= 6
    for name, payload in examples:
        payload_validator(name).validate(payload)


def test_the_schemas_are_of_the_dialect_that_asyncapi_asks_for() -> None:
    for schema in document()["components"]["schemas"].values():
        jsonschema_rs.meta.validate({**schema, "$schema": "http://json-schema.org/draft-07/schema#"})
    newer = {"prefixItems", "$defs", "dependentRequired", "unevaluatedProperties"}
    assert not [each for each in objects(document()) if newer & each.keys()]
