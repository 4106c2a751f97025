"""The choice of a media type by the Accept header."""

from __future__ import annotations

import pytest

from lanestream.api.rest import preferred_media_type

AVAILABLE = ["application/json", "image/jpeg", "image/png"]


@pytest.mark.parametrize(
    ("accept", "chosen"),
    [
        ("*/*", "application/json"),
        ("image/png", "image/png"),
        ("IMAGE/PNG", "image/png"),
        ("image/*", "image/jpeg"),
        ("image/png;q=0.9, image/jpeg;q=0.1", "image/png"),
        ("text/html, */*;q=0.1", "application/json"),
        ("application/json;q=0, */*", "image/jpeg"),
        ("text/html", None),
        ("image/png;q=x", None),
        ("", None),
    ],
)
def test_the_preferred_media_type_is_chosen(accept: str, chosen: str | None) -> None:
    assert preferred_media_type(accept, AVAILABLE) == chosen
