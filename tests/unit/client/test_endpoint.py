"""Places of a service, and what must not be seen of them."""

from __future__ import annotations

import pytest

from lanestream.errors import SettingsError
from lanestream_client import AsyncLaneClient, LaneClient
from lanestream_client.endpoint import Endpoint, endpoints


@pytest.mark.parametrize(
    ("url", "http", "stream"),
    [
        ("http://h:8000", "http://h:8000", "ws://h:8000/v1/stream"),
        ("h:8000/", "http://h:8000", "ws://h:8000/v1/stream"),
        ("wss://h/below/v1/stream", "https://h/below", "wss://h/below/v1/stream"),
    ],
)
def test_one_url_for_requests_and_streams(url: str, http: str, stream: str) -> None:
    place = Endpoint.parse(url)
    assert (place.base, place.http, place.stream, place.headers) == (url, http, stream, {})


def test_several_replicas() -> None:
    assert [place.base for place in endpoints(["http://a", "http://b"])] == ["http://a", "http://b"]
    for urls in ([], ["http://a", "ftp://b"]):
        with pytest.raises(SettingsError, match="no address"):
            endpoints(urls)


def test_a_key_goes_into_the_header_and_nowhere_else() -> None:
    (place,) = endpoints("http://user:hidden@h", "hidden")
    assert place.headers == {"Authorization": "Bearer hidden"}
    assert place.base == "http://h"
    for client in (LaneClient, AsyncLaneClient):
        assert "hidden" not in repr(place) + repr(client("http://h", api_key="hidden"))


@pytest.mark.parametrize("key", ["", "two words", "line\nbreak", "schl\u00fcssel"])
def test_a_key_that_no_header_can_carry_is_refused_without_telling_it(key: str) -> None:
    with pytest.raises(SettingsError, match="the API key can't be sent") as caught:
        LaneClient(api_key=key)
    assert not key or key not in str(caught.value)


def test_a_url_that_is_none_is_told_without_its_password() -> None:
    with pytest.raises(SettingsError) as caught:
        LaneClient("ftp://user:hidden@h")
    assert "ftp://h" in str(caught.value)
    assert "hidden" not in str(caught.value)
