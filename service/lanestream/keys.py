"""API keys: random tokens of which a service knows the hashes alone."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from lanestream.errors import SettingsError

# Of characters that a header and a WebSocket subprotocol may have. The beginning is there for those who search for keys
# that have got somewhere they should not be.
_PREFIX: Final = "lane_"
_RANDOM_BYTES: Final = 32
_NAME: Final = re.compile(r"[A-Za-z0-9._-]{1,64}")
_DIGEST: Final = re.compile(r"[0-9a-f]{64}")
_FORM: Final = "NAME:SHA256 is expected, as `lanestream key NAME` prints it"


@dataclass(frozen=True)
class ApiKey:
    """What a service knows of a key: its name, and the SHA-256 of the token in hexadecimal digits.

    A plain hash will do, unlike for passwords: nobody guesses 256 random bits.
    """

    name: str
    digest: str = field(repr=False)

    def __str__(self) -> str:
        return f"{self.name}:{self.digest}"


def new_key(name: str) -> tuple[str, ApiKey]:
    """A new token, and what a service has to know of it. Raises SettingsError for a name that can't be one."""
    if not _NAME.fullmatch(name):
        raise SettingsError(
            f"{name!r} can't be the name of a key",
            "1 to 64 letters, digits, dots, hyphens and underscores are accepted",
        )
    token = _PREFIX + secrets.token_urlsafe(_RANDOM_BYTES)
    return token, ApiKey(name, _digest(token))


def find(keys: Sequence[ApiKey], token: str) -> ApiKey | None:
    """The key whose token this is. How long that takes tells nothing of the keys."""
    digest, found = _digest(token), None
    for key in keys:
        if hmac.compare_digest(key.digest, digest):
            found = key
    return found


def parse_keys(entries: Iterable[str], unit: str) -> tuple[ApiKey, ...]:
    """The keys of `entries`, each NAME:SHA256; empty ones and those that begin with # are none.

    Two keys of one name are one caller, so that a key can be replaced without a gap. Raises ValueError, which tells the
    number of the `unit` and nothing of what it has, and where there is no key at all.
    """
    keys = tuple(_parsed(entries, unit))
    if not keys:
        raise ValueError(f"no key in it; {_FORM}")
    return keys


def read_keys(path: Path) -> tuple[ApiKey, ...]:
    """The keys of a file, one a line. Raises SettingsError where it can't be read, and for what is no key."""
    try:
        return parse_keys(path.read_text(encoding="utf-8-sig").splitlines(), "line")
    except OSError as error:
        reason = (error.strerror or "it can't be read").lower()
    except UnicodeDecodeError:
        reason = "it is no text"
    except ValueError as error:
        reason = str(error)
    raise SettingsError(f"API keys file {path}: {reason}")


def _parsed(entries: Iterable[str], unit: str) -> Iterator[ApiKey]:
    for number, entry in enumerate(entries, start=1):
        text = entry.strip()
        if not text or text.startswith("#"):
            continue
        name, _, digest = text.partition(":")
        digest = digest.strip().lower()
        if not (_NAME.fullmatch(name) and _DIGEST.fullmatch(digest)):
            raise ValueError(f"{unit} {number} is no key; {_FORM}")
        yield ApiKey(name, digest)


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
