"""The AsyncAPI document agrees with the models, and docs/asyncapi.yaml with the document."""

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
    CalibrationChangedModel,
    CalibrationModel,
    CameraModel,
    DepartureEventModel,
    DepartureModel,
    DepartureOptions,
    DrainingMessage,
    EgoModel,
    EndMessage,
    ErrorMessage,
    FrameMessage,
    LaneChangeModel,
    LaneModel,
    LanesMessage,
    LineModel,
    MarkingModel,
    Message,
    SceneCutModel,
    StartMessage,
    StrictMessage,
    SummaryMessage,
    TimingModel,
    json_schemas,
    warning_message,
)

ROOT = Path(__file__).parents[3]
FILE = ROOT / "docs" / "asyncapi.yaml"

LANE = LaneModel(
    track_id=3,
    position=-1,
    state="detected",
    probability=0.9,
    kind_probability=0.95,
    marking=MarkingModel(type="dashed", type_probability=0.98, color="white", color_probability=0.99, probability=0.97),
    points=[(1.0, 2.0), (3.0, 1.0)],
    line=LineModel(bottom=(1.0, 2.0), top=(3.0, 1.0)),
    horizon=0.5,
    coefficients=(1.0, 2.0, 3.0),
    covariance=[[1.0] * 3] * 3,
    age_s=0.1,
    ground=(0.0, 0.1, 1.8),
    ground_covariance=[[1.0] * 3] * 3,
)
LANES = LanesMessage(
    seq=1,
    timestamp=0.04,
    width=320,
    height=180,
    horizon=72.0,
    lanes=[LANE],
    ego=EgoModel(left=3, right=None, left_kind="marking", offset=None, lateral_speed=-0.2, lateral_speed_sigma=0.1),
    departure=DepartureModel(state="warning", side="left", time_to_crossing=0.8),
    calibration=CalibrationModel(pitch=1.0, pitch_sigma=0.1, yaw=-1.0, yaw_sigma=0.1, settled=True),
    events=[
        LaneChangeModel(track_id=3, direction="left", timestamp=0.03),
        DepartureEventModel(state="warning", side="left", track_id=3, timestamp=0.03),
        SceneCutModel(timestamp=0.04),
        CalibrationChangedModel(pitch=1.0, yaw=-1.0, timestamp=0.04),
    ],
    dropped=0,
    timing_ms=TimingModel(decode=1, propose=1, queue=1, infer=1, track=1, total=5),
)
MESSAGES: list[Message] = [
    StartMessage(
        mode="all",
        camera=CameraModel(height=1.4, field_of_view=62.0),
        departure=DepartureOptions(vehicle_width=1.9),
        kinds=("marking",),
    ),
    FrameMessage(seq=7, timestamp=-0.5, speed=20.0, indicator="left"),
    EndMessage(),
    fakes.ready(),
    LANES,
    warning_message("timestamps_not_advancing", 1),
    ErrorMessage(code="bad_image", message="m"),
    DrainingMessage(resume_token=None, deadline_s=10.0),
    SummaryMessage(frames=1, answered=1, failed=0, dropped=0, duration_s=1.0),
]


def objects(value: Any) -> Iterator[dict[str, Any]]:
    """Yields every object in a document, at any depth."""
    if isinstance(value, dict):
        yield value
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from objects(inner)


def resolve(reference: str) -> Any:
    value: Any = document()
    for name in reference.removeprefix("#/").split("/"):
        value = value[name]
    return value


def payload_validator(name: str) -> jsonschema_rs.Draft7Validator:
    """Returns a validator for messages of a type, which can resolve all schemas of the document."""
    payload = document()["components"]["messages"][name]["payload"]
    return jsonschema_rs.Draft7Validator({**payload, "components": document()["components"]})


def test_the_file_is_up_to_date() -> None:
    spec = importlib.util.spec_from_file_location("asyncapi", ROOT / "tools" / "asyncapi.py")
    assert spec is not None
    assert spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    assert FILE.read_text() == tool.to_yaml(), "make asyncapi"
    assert yaml.safe_load(FILE.read_text()) == document()


def test_every_reference_can_be_resolved() -> None:
    references = [each["$ref"] for each in objects(document()) if "$ref" in each]
    assert len(references) > 30
    for reference in references:
        assert isinstance(resolve(reference), dict)


def test_exactly_the_messages_of_the_protocol_are_documented() -> None:
    documented = {message["name"] for message in document()["components"]["messages"].values()}
    in_protocol = {
        name.removesuffix("Message").lower()
        for side in json_schemas().values()
        for name in side["$defs"]
        if name.endswith("Message")
    }
    assert documented == in_protocol | {"image"}
    in_use = {
        reference["$ref"].rpartition("/")[2]
        for operation in document()["operations"].values()
        for reference in [*operation["messages"], *operation.get("reply", {}).get("messages", [])]
    }
    assert in_use == documented


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.type)
def test_the_schemas_accept_valid_messages_and_refuse_others(message: Any) -> None:
    validator = payload_validator(message.type)
    value = json.loads(message.model_dump_json())
    validator.validate(value)
    # A later version of the service may add fields; a client's unknown field is a typing mistake.
    assert validator.is_valid({**value, "more": 1}) is not isinstance(message, StrictMessage)
    assert not validator.is_valid({**value, "type": "other"})


def test_the_examples_are_valid_messages() -> None:
    messages = document()["components"]["messages"]
    examples = [
        (name, example["payload"]) for name, message in messages.items() for example in message.get("examples", ())
    ]
    assert len(examples) >= 6
    for name, payload in examples:
        payload_validator(name).validate(payload)


def test_the_json_schemas_name_all_messages() -> None:
    assert {"start", "frame", "end"} == set(json_schemas()["client"]["discriminator"]["mapping"])
    server = json_schemas()["server"]["discriminator"]["mapping"]
    assert {"ready", "lanes", "warning", "error", "draining", "summary"} == set(server)


def test_the_schemas_use_the_dialect_that_asyncapi_requires() -> None:
    for schema in document()["components"]["schemas"].values():
        jsonschema_rs.meta.validate({**schema, "$schema": "http://json-schema.org/draft-07/schema#"})
    newer = {"prefixItems", "$defs", "dependentRequired", "unevaluatedProperties"}
    assert not [each for each in objects(document()) if newer & each.keys()]
