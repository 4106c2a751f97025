"""Errors: their codes, what they look like on the wire, and missing packages."""

from __future__ import annotations

import pytest

from lanestream import errors
from lanestream.errors import LanestreamError, MissingExtraError, WireStatus, error_from_code, needs_extra, wire_status
from lanestream.protocol import error_message


def test_codes_are_unique_and_identify_the_class() -> None:
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, LanestreamError)]
    assert len({kind.code for kind in kinds}) == len(kinds)
    for kind in kinds:
        assert type(error_from_code(kind.code, "m", "h")) is kind
    assert wire_status(error_from_code("image_too_large", "m")) == WireStatus(413, 1009)
    assert wire_status(ValueError()) == WireStatus(500, 1011)


def test_unexpected_errors_reveal_no_details() -> None:
    assert "secret" not in error_message(ValueError("secret"), seq=3).model_dump_json()


def test_a_missing_package_is_named_with_the_command_that_installs_it() -> None:
    message = r"package no_such_package.*pip install 'lanestream\[video\]'"
    with pytest.raises(MissingExtraError, match=message), needs_extra("video"):
        import no_such_package  # noqa: F401
