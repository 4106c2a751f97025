"""The small things at the edges: Accept headers, addresses, settings, errors, the closing report."""

from __future__ import annotations

import pytest

from lanestream import errors
from lanestream.api.content_negotiation import preferred
from lanestream.errors import LanestreamError, MissingExtraError, SettingsError, answer_to, error_of, needs_extra
from lanestream.host import processors
from lanestream.protocol import EgoModel, LanesMessage, TimingModel, error_message, schemas
from lanestream.settings import Settings, load_settings
from lanestream_client.endpoint import Endpoint
from lanestream_client.report import Tally, percentile
from lanestream_client.service import ServiceInfo

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
def test_what_is_no_address_is_refused(url: str) -> None:
    with pytest.raises(SettingsError, match="no address"):
        Endpoint.parse(url)


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


def test_the_report_counts_and_measures() -> None:
    tally = Tally()
    for number in range(1, 101):
        timing = TimingModel(decode=1, propose=2, queue=0, infer=number, track=0.5, total=number + 3.5)
        ego = EgoModel(left=1, right=2 if number % 2 else None, offset=None)
        tally.answered(
            LanesMessage(
                seq=number,
                timestamp=0,
                width=9,
                height=9,
                horizon=1,
                lanes=[],
                ego=ego,
                events=[],
                dropped=0,
                timing_ms=timing,
            )
        )
    tally.fail()
    report = tally.report(ServiceInfo("m 1", "cpu"), dropped=4)
    assert report.startswith("105 frames: 100 answered, 4 dropped, 1 failed; ")
    assert "both ego boundaries in 50.0 %" in report
    assert "infer       50.00    95.00" in report
    assert report.endswith("model m 1 on cpu")
    assert "ms" not in Tally().report(ServiceInfo("m 1", "cpu")).split()


def test_percentiles_are_values_that_occurred() -> None:
    assert [percentile([1.0, 2.0, 3.0, 4.0], share) for share in (0, 25, 50, 95, 100)] == [1.0, 1.0, 2.0, 4.0, 4.0]
