"""Every accepted form of a service's address, and what is refused."""

from __future__ import annotations

import pytest

from lanestream.errors import SettingsError
from lanestream_client.endpoint import Endpoint


@pytest.mark.parametrize(
    ("url", "http", "stream"),
    [
        ("http://a:8000", "http://a:8000", "ws://a:8000/v1/stream"),
        ("https://a/", "https://a", "wss://a/v1/stream"),
        ("ws://a:1/v1/stream", "http://a:1", "ws://a:1/v1/stream"),
        ("a:8000", "http://a:8000", "ws://a:8000/v1/stream"),
        ("https://a/behind/proxy/", "https://a/behind/proxy", "wss://a/behind/proxy/v1/stream"),
        ("http://[::1]:9", "http://[::1]:9", "ws://[::1]:9/v1/stream"),
    ],
)
def test_one_address_serves_requests_and_streams(url: str, http: str, stream: str) -> None:
    endpoint = Endpoint.parse(url)
    assert (endpoint.base, endpoint.http, endpoint.stream) == (url, http, stream)


@pytest.mark.parametrize("url", ["", "ftp://a", "http://", "http:///x", "http://[::1", "http://a:99999", "a:b"])
def test_an_invalid_address_is_refused(url: str) -> None:
    with pytest.raises(SettingsError, match="no address"):
        Endpoint.parse(url)
