"""Which proxy leads to a service, by the variables HTTP_PROXY, HTTPS_PROXY, ALL_PROXY and NO_PROXY.

Requests and streams go the same way. The rules are curl's, with these differences: a service on this machine is never
reached through a proxy, NO_PROXY may hold networks such as 10.0.0.0/8, and `socks://`, which desktops set, is SOCKS 5.
Without variables, the settings of macOS and Windows apply.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from importlib.util import find_spec
from ipaddress import IPv4Address, IPv6Address, ip_address, ip_network
from typing import Final
from urllib.parse import SplitResult, urlsplit
from urllib.request import getproxies, proxy_bypass

from lanestream.errors import MissingExtraError, SettingsError

_DEFAULT_PORTS: Final = {"http": 80, "https": 443, "socks5": 1080, "socks5h": 1080}
# With `socks5h` the proxy resolves the name of the service.
_SOCKS: Final = "socks5h"
_SOCKS_PACKAGES: Final = ("socksio", "python_socks")


@dataclass(frozen=True)
class Proxy:
    """A proxy: its `url` for httpx and websockets, and for people its `name` and the variable that names it."""

    url: str = field(repr=False)
    name: str
    variable: str

    def __str__(self) -> str:
        return f"the proxy {self.name} of {self.variable}"


def find_proxy(url: str) -> Proxy | None:
    """Returns the proxy to the http or https URL of a service, or None if it is reached directly.

    Raises SettingsError if the proxy's URL is not valid, and MissingExtraError if it needs packages that are missing.
    """
    parts = urlsplit(url)
    host = (parts.hostname or "").rstrip(".")
    port = parts.port or _DEFAULT_PORTS[parts.scheme]
    proxies = getproxies()
    if _is_local(host) or _is_excluded(host, port, proxies.get("no", "")) or proxy_bypass(f"{host}:{port}"):
        return None
    for kind in (parts.scheme, "all", "socks"):
        if proxies.get(kind):
            return _parse(proxies[kind], kind, host)
    return None


def _parse(text: str, kind: str, host: str) -> Proxy:
    variable = next((name for name in (f"{kind}_proxy", f"{kind}_proxy".upper()) if name in os.environ), "the system")
    hint = f"give a URL such as http://proxy:3128 or socks5://proxy:1080, or add {host} to NO_PROXY"
    try:
        parts = urlsplit(text if "://" in text else f"http://{text}")
        scheme = _SOCKS if parts.scheme == "socks" or kind == "socks" else parts.scheme
        valid = scheme in _DEFAULT_PORTS and bool(parts.hostname)
        name = f"{scheme}://{_bracketed(parts)}:{parts.port or _DEFAULT_PORTS.get(scheme, 0)}"
    except ValueError:
        valid, name = False, ""
    if not valid:
        raise SettingsError(f"{_without_login(text)!r} in {variable} is not a valid proxy", hint)
    if scheme.startswith("socks") and not all(find_spec(package) for package in _SOCKS_PACKAGES):
        raise MissingExtraError(
            f"the proxy {name} of {variable} needs packages that are not installed",
            f"pip install 'lanestream[socks]', or add {host} to NO_PROXY",
        )
    login, at, _ = parts.netloc.rpartition("@")
    # websockets requires a password, which may be empty.
    login += ":" if at and ":" not in login else ""
    return Proxy(name.replace("://", f"://{login}{at}"), name, variable)


def _bracketed(parts: SplitResult) -> str:
    host = parts.hostname or ""
    return f"[{host}]" if ":" in host else host


def _without_login(text: str) -> str:
    return re.sub(r"^([^/]*//)?.*@", r"\1", text)


def _is_local(host: str) -> bool:
    """Returns whether a host is this machine, or can only be reached directly."""
    address = _address(host)
    if address is None:
        return host == "localhost" or host.endswith(".localhost")
    return address.is_loopback or address.is_link_local or address.is_unspecified


def _address(host: str) -> IPv4Address | IPv6Address | None:
    try:
        address = ip_address(host)
    except ValueError:
        return None
    return (address.ipv4_mapped if isinstance(address, IPv6Address) else None) or address


def _is_excluded(host: str, port: int, no_proxy: str) -> bool:
    """Returns whether NO_PROXY holds the host: its name, a domain above it, its network, or `*`."""
    address = _address(host)
    for entry in re.split(r"[\s,]+", no_proxy.lower()):
        name, _, given_port = entry.rpartition(":") if re.fullmatch(r"([^:]+|\[.*\]):\d+", entry) else (entry, "", "")
        name = name.removeprefix("*").strip(".[]")
        if entry == "*":
            return True
        if not name or given_port not in ("", str(port)):
            continue
        if host == name or host.endswith(f".{name}") or (address is not None and _is_in_network(address, name)):
            return True
    return False


def _is_in_network(address: IPv4Address | IPv6Address, text: str) -> bool:
    try:
        return address in ip_network(text, strict=False)
    except ValueError:
        return False
