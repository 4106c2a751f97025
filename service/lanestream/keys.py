"""API keys: random tokens. The service stores only their hashes."""

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

# Tokens use only characters that are valid in a header and in a WebSocket subprotocol. The prefix helps secret scanners
# to find tokens that were leaked.
_PREFIX: Final = "lane_"
_RANDOM_BYTES: Final = 32
_NAME: Final = re.compile(r"[A-Za-z0-9._-]{1,64}")
_DIGEST: Final = re.compile(r"[0-9a-f]{64}")
_FORMAT: Final = "expected NAME:SHA256, as printed by `lanestream key NAME`"


@dataclass(frozen=True)
class ApiKey:
    """The stored form of a key: its name, and the SHA-256 of its token in hexadecimal.

    Unlike a password, a token of 256 random bits can't be guessed, so a plain hash is sufficient.
    """

    name: str
    digest: str = field(repr=False)

    def __str__(self) -> str:
        return f"{self.name}:{self.digest}"


def new_key(name: str) -> tuple[str, ApiKey]:
    """Returns a new token and its stored form. Raises SettingsError for an invalid name."""
    if not _NAME.fullmatch(name):
        raise SettingsError(
            f"{name!r} is not a valid name for a key",
            "use 1 to 64 letters, digits, dots, hyphens and underscores",
        )
    token = _PREFIX + secrets.token_urlsafe(_RANDOM_BYTES)
    return token, ApiKey(name, _digest(token))


def find_key(keys: Sequence[ApiKey], token: str) -> ApiKey | None:
    """Returns the key of this token. The running time does not depend on where the digests differ."""
    digest, found = _digest(token), None
    for key in keys:
        if hmac.compare_digest(key.digest, digest):
            found = key
    return found


def parse_keys(entries: Iterable[str], unit: str) -> tuple[ApiKey, ...]:
    """Returns the keys in `entries`, each NAME:SHA256. Skips empty entries and comments (#).

    Two keys with the same name are one caller, so a key can be replaced without downtime. Raises ValueError for an
    invalid entry, which is identified by `unit` and number and never quoted, and if there is no key at all.
    """
    keys = tuple(_parse_entries(entries, unit))
    if not keys:
        raise ValueError(f"no key found; {_FORMAT}")
    return keys


def read_keys(path: Path) -> tuple[ApiKey, ...]:
    """Returns the keys in a file, one per line. Raises SettingsError if it can't be read or a line is not a key."""
    try:
        return parse_keys(path.read_text(encoding="utf-8-sig").splitlines(), "line")
    except OSError as error:
        reason = (error.strerror or "the file can't be read").lower()
    except UnicodeDecodeError:
        reason = "not a UTF-8 text file"
    except ValueError as error:
        reason = str(error)
    raise SettingsError(f"API keys file {path}: {reason}")


def _parse_entries(entries: Iterable[str], unit: str) -> Iterator[ApiKey]:
    for number, entry in enumerate(entries, start=1):
        text = entry.strip()
        if not text or text.startswith("#"):
            continue
        name, _, digest = text.partition(":")
        digest = digest.strip().lower()
        if not (_NAME.fullmatch(name) and _DIGEST.fullmatch(digest)):
            raise ValueError(f"{unit} {number} is not a valid key; {_FORMAT}")
        yield ApiKey(name, digest)


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
