"""API keys: creating, reading and finding them."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from lanestream.errors import SettingsError
from lanestream.keys import ApiKey, find_key, new_key, parse_keys, read_keys


def test_only_its_token_finds_a_key() -> None:
    tokens, keys = zip(*(new_key(f"camera-{number}") for number in range(3)), strict=True)
    assert len(set(tokens)) == 3
    for token, key in zip(tokens, keys, strict=True):
        assert find_key(keys, token) == key
        assert key.digest == hashlib.sha256(token.encode()).hexdigest()
        assert token not in str(key)
    for wrong in ("", "x", tokens[0][:-1], tokens[0] + "x", keys[0].digest, "ÿ€"):
        assert find_key(keys, wrong) is None
    assert find_key((), tokens[0]) is None


def test_a_token_is_valid_in_a_header_and_in_a_subprotocol() -> None:
    token, _ = new_key("x")
    assert token.isascii()
    assert token.replace("-", "").replace("_", "").isalnum()


def test_a_hash_is_not_shown() -> None:
    _, key = new_key("x")
    assert key.digest not in repr(key)


@pytest.mark.parametrize("name", ["", "a b", "a:b", "ä", "x" * 65, "a\n"])
def test_an_invalid_name_is_refused(name: str) -> None:
    with pytest.raises(SettingsError, match="is not a valid name for a key"):
        new_key(name)


def test_printed_keys_can_be_read(tmp_path: Path) -> None:
    one, other = (new_key(name)[1] for name in ("one", "other"))
    file = tmp_path / "keys"
    file.write_bytes(
        f"\ufeff# our keys\r\n{one}\r\n\r\n  # the old one\n  {str(other).replace('other:', 'one:')}  \n".encode()
    )
    assert read_keys(file) == (one, ApiKey("one", other.digest)), "two keys with one name are one caller"


DIGEST = "0123456789abcdef" * 4


@pytest.mark.parametrize(
    "bad",
    ["secret", f"secret:{DIGEST[1:]}", f"secret:{DIGEST}0", f":{DIGEST}", f"se cret:{DIGEST}", f"secret:x{DIGEST[1:]}"],
)
def test_an_invalid_key_is_reported_by_its_line_and_never_quoted(tmp_path: Path, bad: str) -> None:
    file = tmp_path / "keys"
    file.write_text(f"# keys\ngood:{DIGEST}\n{bad}\n")
    with pytest.raises(SettingsError, match=r"keys: line 3 is not a valid key; expected NAME:SHA256") as caught:
        read_keys(file)
    assert "secret" not in str(caught.value)
    assert DIGEST[1:9] not in str(caught.value)


@pytest.mark.parametrize(
    ("data", "message"),
    [(None, "no such file"), (b"", "no key found"), (b"# none\n", "no key found"), (b"\xff", "not a UTF-8 text file")],
)
def test_a_file_without_keys_is_refused(tmp_path: Path, data: bytes | None, message: str) -> None:
    file = tmp_path / "keys"
    if data is not None:
        file.write_bytes(data)
    with pytest.raises(SettingsError, match=message):
        read_keys(file)


def test_digests_may_be_in_upper_case() -> None:
    assert parse_keys([f"a:{DIGEST.upper()}"], "entry") == (ApiKey("a", DIGEST),)
