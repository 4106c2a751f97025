"""API keys: made, read, found."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from lanestream.errors import SettingsError
from lanestream.keys import ApiKey, find, new_key, parse_keys, read_keys


def test_a_key_is_found_by_its_token_alone() -> None:
    tokens, keys = zip(*(new_key(f"camera-{number}") for number in range(3)), strict=True)
    assert len(set(tokens)) == 3
    for token, key in zip(tokens, keys, strict=True):
        assert find(keys, token) == key
        assert key.digest == hashlib.sha256(token.encode()).hexdigest()
        assert token not in str(key)
    for wrong in ("", "x", tokens[0][:-1], tokens[0] + "x", keys[0].digest, "ÿ€"):
        assert find(keys, wrong) is None
    assert find((), tokens[0]) is None


def test_a_token_fits_into_a_header_and_into_a_subprotocol() -> None:
    token, _ = new_key("x")
    assert token.isascii()
    assert token.replace("-", "").replace("_", "").isalnum()


def test_a_hash_is_not_shown() -> None:
    _, key = new_key("x")
    assert key.digest not in repr(key)


@pytest.mark.parametrize("name", ["", "a b", "a:b", "ä", "x" * 65, "a\n"])
def test_a_name_that_would_not_be_read_back_is_refused(name: str) -> None:
    with pytest.raises(SettingsError, match="can't be the name of a key"):
        new_key(name)


def test_what_is_printed_is_read_back(tmp_path: Path) -> None:
    one, other = (new_key(name)[1] for name in ("one", "other"))
    file = tmp_path / "keys"
    file.write_bytes(
        f"\ufeff# our keys\r\n{one}\r\n\r\n  # the old one\n  {str(other).replace('other:', 'one:')}  \n".encode()
    )
    assert read_keys(file) == (one, ApiKey("one", other.digest)), "two keys of one name are one caller"


DIGEST = "0123456789abcdef" * 4


@pytest.mark.parametrize(
    "bad",
    ["secret", f"secret:{DIGEST[1:]}", f"secret:{DIGEST}0", f":{DIGEST}", f"se cret:{DIGEST}", f"secret:x{DIGEST[1:]}"],
)
def test_what_is_no_key_is_told_by_its_line_and_not_shown(tmp_path: Path, bad: str) -> None:
    file = tmp_path / "keys"
    file.write_text(f"# keys\ngood:{DIGEST}\n{bad}\n")
    with pytest.raises(SettingsError, match=r"keys: line 3 is no key; NAME:SHA256 is expected") as caught:
        read_keys(file)
    assert "secret" not in str(caught.value)
    assert DIGEST[1:9] not in str(caught.value)


@pytest.mark.parametrize(
    ("data", "said"),
    [(None, "no such file"), (b"", "no key in it"), (b"# none\n", "no key in it"), (b"\xff", "no text")],
)
def test_a_file_without_keys_opens_no_door(tmp_path: Path, data: bytes | None, said: str) -> None:
    file = tmp_path / "keys"
    if data is not None:
        file.write_bytes(data)
    with pytest.raises(SettingsError, match=said):
        read_keys(file)


def test_upper_case_digits_are_the_same() -> None:
    assert parse_keys([f"a:{DIGEST.upper()}"], "entry") == (ApiKey("a", DIGEST),)
