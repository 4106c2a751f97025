"""Which addresses are trusted proxies."""

from __future__ import annotations

import pytest

from lanestream.api.service import proxy_check


@pytest.mark.parametrize(
    ("proxies", "address", "expected"),
    [
        ("", "127.0.0.1", False),
        ("127.0.0.1", "127.0.0.1", True),
        ("127.0.0.1", "127.0.0.2", False),
        ("10.0.0.0/8, ::1", "10.1.2.3", True),
        ("10.0.0.0/8, ::1", "::1", True),
        ("*", "192.0.2.7", True),
        ("proxy.example.com", "192.0.2.7", False),
        ("10.0.0.0/8", "local", False),
    ],
)
def test_proxies_are_addresses_and_networks(proxies: str, address: str, expected: bool) -> None:
    assert proxy_check(proxies)(address) is expected
