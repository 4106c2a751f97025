"""The REST API conforms to its OpenAPI document: requests are generated from that document."""

from __future__ import annotations

import fakes
import httpx
import pytest
import schemathesis
from hypothesis import given, settings
from hypothesis import strategies as st
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi import checks

from lanestream.api import create_app
from lanestream.settings import Settings
from lanestream_client.overlays import draw_lanes

CHECKS = [
    not_a_server_error,
    checks.status_code_conformance,
    checks.content_type_conformance,
    checks.response_schema_conformance,
    checks.response_headers_conformance,
]
DOCUMENT = schemathesis.openapi.from_dict(create_app(None, Settings(), draw_lanes).openapi())
# A parameter that is too long may make the URL too long.
DOCUMENT.config.checks.negative_data_rejection.expected_statuses = [400, 401, 403, 404, 405, 406, 409, 414, 415, 422]
OPERATIONS = {result.ok().label: result.ok() for result in DOCUMENT.get_all_operations()}
DETECT = "POST /v1/detect"
GENERATED = [(label, GenerationMode.POSITIVE) for label in OPERATIONS] + [(DETECT, GenerationMode.NEGATIVE)]
BODIES = [
    *(fakes.image_file(kind) for kind in (".jpg", ".png", ".webp")),
    fakes.image_file()[:900],
    fakes.image_file(".png", 8000, 1200, 0),
    b"no image",
]
ACCEPT_HEADERS = [
    "application/json",
    "image/png",
    "image/*;q=0.5, text/html",
    "*/*",
    "text/html",
    "",
    "image/jpeg;q=nan",
    ";,=",
]

exhaustive = settings(max_examples=60, derandomize=True, deadline=None, database=None)


def test_the_document_describes_every_request() -> None:
    assert OPERATIONS.keys() >= {
        DETECT,
        "GET /v1/models",
        "GET /v1/schema",
        "GET /v1/asyncapi.json",
        "GET /healthz",
        "GET /readyz",
        "GET /metrics",
    }


@pytest.mark.parametrize(("label", "mode"), GENERATED)
@given(data=st.data())
@exhaustive
def test_every_response_is_documented(both_url: str, label: str, mode: GenerationMode, data: st.DataObject) -> None:
    case = data.draw(OPERATIONS[label].as_strategy(generation_mode=mode))
    case.call_and_validate(
        base_url=both_url, checks=[*CHECKS, checks.negative_data_rejection, checks.unsupported_method]
    )


def test_every_response_to_an_image_is_documented(both_url: str) -> None:
    statuses: set[int] = set()

    @given(data=st.data(), body=st.sampled_from(BODIES), accept=st.sampled_from(ACCEPT_HEADERS))
    @exhaustive
    def detect(data: st.DataObject, body: bytes, accept: str) -> None:
        case = data.draw(OPERATIONS[DETECT].as_strategy(generation_mode=GenerationMode.POSITIVE))
        case.media_type, case.body = "image/jpeg", body
        case.headers["accept"] = accept
        response = case.call(base_url=both_url)
        statuses.add(response.status_code)
        case.validate_response(response, checks=CHECKS)

    detect()
    # Whether 60 generated requests have a valid query with every body depends on their random choices.
    statuses |= {httpx.post(f"{both_url}/v1/detect", content=body).status_code for body in BODIES}
    assert statuses >= {200, 406, 413, 415, 422}
