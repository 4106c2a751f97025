"""Which proxy leads to a service."""

from __future__ import annotations

import os
from importlib.util import find_spec

import pytest

from lanestream.errors import MissingExtraError, SettingsError
from lanestream_client import LaneClient, proxies
from lanestream_client.endpoint import Endpoint
from lanestream_client.proxies import find_proxy


@pytest.fixture(autouse=True)
def no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.lower().endswith("_proxy")]:
        monkeypatch.delenv(name)


@pytest.mark.parametrize(
    ("variables", "url", "expected"),
    [
        ({}, "http://lanes.test", None),
        ({"HTTP_PROXY": "http://p:3128"}, "http://lanes.test", "http://p:3128"),
        ({"http_proxy": "p:3128"}, "http://lanes.test", "http://p:3128"),
        ({"http_proxy": "p"}, "http://lanes.test", "http://p:80"),
        ({"HTTP_PROXY": "http://p:3128/"}, "http://lanes.test", "http://p:3128"),
        ({"HTTPS_PROXY": "http://p:3128"}, "http://lanes.test", None),
        ({"HTTPS_PROXY": "https://p"}, "wss://lanes.test", "https://p:443"),
        ({"HTTP_PROXY": "http://a:1", "ALL_PROXY": "http://b:2"}, "http://lanes.test", "http://a:1"),
        ({"HTTP_PROXY": "http://a:1", "ALL_PROXY": "http://b:2"}, "https://lanes.test", "http://b:2"),
        ({"ALL_PROXY": "socks://p:1080/"}, "http://lanes.test", "socks5h://p:1080"),
        ({"all_proxy": "socks5://p"}, "http://lanes.test", "socks5://p:1080"),
        ({"SOCKS_PROXY": "p:9"}, "http://lanes.test", "socks5h://p:9"),
        ({"HTTP_PROXY": "http://me:sec@ret@p:1"}, "http://lanes.test", "http://me:sec@ret@p:1"),
        ({"HTTP_PROXY": "http://me@p:1"}, "http://lanes.test", "http://me:@p:1"),
        ({"HTTP_PROXY": "http://[::2]:1"}, "http://lanes.test", "http://[::2]:1"),
        ({"HTTP_PROXY": ""}, "http://lanes.test", None),
    ],
)
def test_the_proxy_of_a_url(
    variables: dict[str, str], url: str, expected: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    proxy = Endpoint.parse(url).proxy
    assert (proxy and proxy.url) == expected
    assert "ret" not in f"{proxy} {proxy!r}"


@pytest.mark.parametrize(
    "url",
    ["http://127.0.0.1:8000", "http://127.8.9.1", "http://localhost:8000", "http://LOCALHOST", "http://a.localhost",
     "http://[::1]:8000", "http://[::ffff:127.0.0.1]", "http://0.0.0.0:8000", "http://169.254.3.4", "127.0.0.1:8000"],
)  # fmt: skip
@pytest.mark.parametrize("proxy", ["http://p:1", "socks://p:1", "nonsense://p", "socks4://p", "http://[", "\\\\p"])
def test_a_service_on_this_machine_is_reached_directly(url: str, proxy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ALL_PROXY", proxy)
    LaneClient(url).close()
    assert Endpoint.parse(url).proxy is None


@pytest.mark.parametrize(
    ("no_proxy", "url", "direct"),
    [
        ("lanes.test", "http://lanes.test:8000", True),
        ("LANES.test", "http://lanes.TEST", True),
        ("lanes.test", "http://a.lanes.test", True),
        ("lanes.test", "http://mylanes.test", False),
        (".lanes.test", "http://a.lanes.test", True),
        ("*.lanes.test", "http://a.lanes.test", True),
        ("a, b lanes.test", "http://lanes.test", True),
        ("lanes.test:8000", "http://lanes.test:8000", True),
        ("lanes.test:8000", "http://lanes.test:9000", False),
        ("lanes.test:80", "http://lanes.test", True),
        ("*", "http://lanes.test", True),
        ("10.0.0.0/8", "http://10.2.3.4:8000", True),
        ("10.0.0.0/8", "http://11.2.3.4:8000", False),
        ("192.168.1.20", "http://192.168.1.20:8000", True),
        ("fd00::/8", "http://[fd00::12]:8000", True),
        ("[fd00::12]:8000", "http://[fd00::12]:8000", True),
        ("fd00::12", "http://[fd00::12]:8000", True),
        ("", "http://192.168.1.20:8000", False),
        (",,/8,:,[", "http://192.168.1.20:8000", False),
    ],
)
def test_what_no_proxy_excludes(no_proxy: str, url: str, direct: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ALL_PROXY", "http://p:1")
    monkeypatch.setenv("NO_PROXY", no_proxy)
    assert (find_proxy(url) is None) == direct


@pytest.mark.parametrize(
    "value",
    ["socks4://p:1", "ftp://p", "http://", "http://[", "http://p:99999", "http://p:x", "nonsense://me:secret@p"],
)
def test_an_invalid_proxy_is_one_line(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ALL_PROXY", value)
    with pytest.raises(SettingsError, match="in ALL_PROXY is not a valid proxy") as caught:
        LaneClient("http://lanes.test")
    assert "or add lanes.test to NO_PROXY" in caught.value.hint
    assert "secret" not in str(caught.value)


def test_a_socks_proxy_names_missing_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ALL_PROXY", "socks://me:secret@p:1080")
    monkeypatch.setattr(proxies, "find_spec", lambda name: None if name == "socksio" else find_spec(name))
    message = (
        "the proxy socks5h://p:1080 of ALL_PROXY needs packages that are not installed "
        "(pip install 'lanestream[socks]', or add lanes.test to NO_PROXY)"
    )
    with pytest.raises(MissingExtraError) as caught:
        LaneClient("http://lanes.test")
    assert str(caught.value) == message
