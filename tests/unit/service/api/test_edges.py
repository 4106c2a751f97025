"""The small things at the edges: Accept headers, settings, errors."""

from __future__ import annotations

import pytest

from lanestream import errors
from lanestream.api.content_negotiation import preferred
from lanestream.errors import LanestreamError, MissingExtraError, SettingsError, answer_to, error_of, needs_extra
from lanestream.host import processors
from lanestream.protocol import error_message, schemas
from lanestream.settings import Settings, load_settings

OFFERED = ["application/json", "image/jpeg", "image/png"]


@pytest.mark.parametrize(
    ("accept", "chosen"),
    [
        ("*/*", "application/json"),
        ("image/png", "image/png"),
        ("IMAGE/PNG", "image/png"),
        ("image/*", "image/jpeg"),
        ("image/png;q=0.9, image/jpeg;q=0.1", "image/png"),
        ("text/html, */*;q=0.1", "application/json"),
        ("application/json;q=0, */*", "image/jpeg"),
        ("text/html", None),
        ("image/png;q=x", None),
        ("", None),
    ],
)
def test_the_best_form_is_chosen(accept: str, chosen: str | None) -> None:
    assert preferred(accept, OFFERED) == chosen


def test_settings_come_from_the_environment_and_the_command_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LANESTREAM_PORT", "81")
    monkeypatch.setenv("LANESTREAM_CREDITS", "3")
    monkeypatch.setenv("LANESTREAM_MODEL", "")
    settings = load_settings(port=82, host=None)
    assert (settings.port, settings.credits, settings.host, settings.model) == (82, 3, "127.0.0.1", None)
    assert (settings.threads_of(1), settings.threads_of(2)) == (processors() + 1, 1)
    assert settings.image_limits.max_bytes == settings.max_bytes


@pytest.mark.parametrize(
    ("name", "value"), [("PORT", "99999"), ("PROVIDER", "tpu"), ("THREADS", "0"), ("MAX_BYTES", "x"), ("HOST", " " * 0)]
)
def test_a_bad_setting_is_named(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(f"LANESTREAM_{name}", value)
    if value == "":
        assert load_settings() == Settings()
        return
    with pytest.raises(SettingsError, match=f"^LANESTREAM_{name} = '{value}': input should be") as caught:
        load_settings()
    assert "\n" not in str(caught.value)


def test_a_bad_option_is_named() -> None:
    with pytest.raises(SettingsError, match=r"^--max-sessions = 0: "):
        load_settings(max_sessions=0)


def test_codes_are_unique_and_come_back_as_what_they_were() -> None:
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, LanestreamError)]
    assert len({kind.code for kind in kinds}) == len(kinds)
    for kind in kinds:
        assert type(error_of(kind.code, "m", "h")) is kind
    assert answer_to(error_of("image_too_large", "m")) == errors.Answer(413, 1009)
    assert answer_to(ValueError()) == errors.Answer(500, 1011)


def test_errors_of_our_own_tell_nothing() -> None:
    assert "secret" not in error_message(ValueError("secret"), seq=3).model_dump_json()


def test_a_missing_package_is_named_with_the_cure() -> None:
    told = r"package no_such_package.*pip install 'lanestream\[video\]'"
    with pytest.raises(MissingExtraError, match=told), needs_extra("video"):
        import no_such_package  # noqa: F401


def test_the_schemas_name_all_messages() -> None:
    assert {"start", "frame", "end"} == set(schemas()["client"]["discriminator"]["mapping"])
    assert {"ready", "lanes", "error", "draining", "summary"} == set(schemas()["server"]["discriminator"]["mapping"])
