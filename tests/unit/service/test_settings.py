"""Settings from the command line, the environment and a file."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import SecretStr
from pydantic_core import PydanticUndefined

from lanestream.errors import SettingsError
from lanestream.host import processors
from lanestream.keys import ApiKey
from lanestream.protocol import DepartureOptions
from lanestream.session import SessionOptions
from lanestream.settings import Settings, load_settings, to_toml
from lanestream.tracking.departure import DepartureSettings

OPERATIONS = Path(__file__).parents[3] / "docs" / "operations.md"
DIGEST = "0123456789abcdef" * 4


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return Path("lanestream.toml")


def test_the_command_line_overrides_the_environment_and_that_the_file(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.write_text('port = 1\nhost = "::1"\ncredits = 2\nmodel = "m.onnx"\n')
    monkeypatch.setenv("LANESTREAM_PORT", "3")
    monkeypatch.setenv("LANESTREAM_HOST", "::2")
    monkeypatch.setenv("LANESTREAM_CREDITS", "")
    found = load_settings(config=file, port=4, host=None)
    assert (found.port, found.host, found.credits, found.model) == (4, "::2", 2, Path("m.onnx"))
    assert found.max_bytes == Settings().max_bytes


def test_limits_follow_from_the_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LANESTREAM_PORT", "81")
    monkeypatch.setenv("LANESTREAM_CREDITS", "3")
    monkeypatch.setenv("LANESTREAM_MODEL", "")
    settings = load_settings(port=82, host=None)
    assert (settings.port, settings.credits, settings.host, settings.model) == (82, 3, "127.0.0.1", None)
    assert (settings.threads_per_process(1), settings.threads_per_process(2)) == (processors() + 1, 1)
    assert settings.image_limits.max_bytes == settings.max_bytes


def test_departure_warnings_have_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Settings().departure_settings == DepartureSettings()
    monkeypatch.setenv("LANESTREAM_DEPARTURE_VEHICLE_WIDTH", "2.5")
    monkeypatch.setenv("LANESTREAM_DEPARTURE_LEAST_SPEED", "0")
    defaults = load_settings().departure_settings
    assert defaults == DepartureSettings(vehicle_width=2.5, least_speed=0.0)
    options = SessionOptions.of(None, None, None, DepartureOptions(vehicle_width=1.9), defaults)
    assert options.departure == DepartureSettings(vehicle_width=1.9, least_speed=0.0)


@pytest.mark.parametrize("value", ["road_edge,marking", "road_edge\nmarking", ["road_edge", "marking"]])
def test_kinds_are_a_string_or_a_list(value: Any) -> None:
    assert load_settings(kinds=value).kinds == ("road_edge", "marking")
    assert Settings().kinds == ("marking", "road_edge")


@pytest.mark.parametrize("value", [",", [], "curb", "marking,curb"])
def test_other_kinds_are_refused_on_one_line(value: Any) -> None:
    with pytest.raises(
        SettingsError, match=r"^--kinds = .*: (input should be 'marking' or 'road_edge'|tuple should)"
    ) as caught:
        load_settings(kinds=value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("LANESTREAM_MAX_SESSION", "did you mean LANESTREAM_MAX_SESSIONS? `lanestream serve --print-config`"),
        ("lanestream_credit", "did you mean LANESTREAM_CREDITS?"),
        ("LANESTREAM_QUITE_ANOTHER", "`lanestream serve --print-config` lists all settings"),
    ],
)
def test_an_unknown_variable_is_refused_with_the_nearest_name(
    name: str, hint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, "a secret?")
    with pytest.raises(SettingsError, match=f"the environment variable {name} is not a setting") as caught:
        load_settings()
    assert caught.value.hint.startswith(hint)
    assert "a secret?" not in str(caught.value)


@pytest.mark.parametrize(
    "name",
    [
        "LANESTREAM_API_KEY",
        "LANESTREAM_DATA",
        "LANESTREAM_PUBLISH",
        "LANESTREAM_SERVICE_HOST",
        "LANESTREAM_PORT_8000_TCP",
    ],
)
def test_variables_of_other_programs_are_ignored(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, "x")
    load_settings()


def test_variables_for_other_services_of_kubernetes_are_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (
        ("LANESTREAM_REDIS_SERVICE_HOST", "10.3.1.2"),
        ("LANESTREAM_REDIS_SERVICE_PORT_REDIS", "6379"),
        ("LANESTREAM_REDIS_PORT", "tcp://10.3.1.2:6379"),
        ("LANESTREAM_REDIS_PORT_6379_TCP_ADDR", "10.3.1.2"),
    ):
        monkeypatch.setenv(name, value)
    load_settings()
    monkeypatch.setenv("LANESTREAM_REDIS_PORT", "6379")
    with pytest.raises(SettingsError, match="LANESTREAM_REDIS_PORT is not a setting"):
        load_settings()


def test_the_port_that_kubernetes_sets_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LANESTREAM_PORT", "tcp://10.3.241.7:8000")
    with pytest.raises(SettingsError, match="Kubernetes") as caught:
        load_settings()
    assert "enableServiceLinks" in caught.value.hint


def test_a_variable_can_name_the_file(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file.write_text("port = 1\n")
    monkeypatch.setenv("LANESTREAM_CONFIG", str(file))
    assert load_settings().port == 1
    other = Path("other.toml")
    other.write_text("port = 2\n")
    assert load_settings(config=other).port == 2


@pytest.mark.parametrize(
    "value",
    [f"a:{DIGEST},b:{DIGEST}", f"\na:{DIGEST}\n# c:{DIGEST}\n b:{DIGEST} \n", [f"a:{DIGEST}", f"b:{DIGEST}"]],
)
def test_keys_are_a_string_or_a_list(value: Any) -> None:
    assert load_settings(api_keys=value).api_keys == (ApiKey("a", DIGEST), ApiKey("b", DIGEST))


def test_lists_come_from_variables_and_from_a_file(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file.write_text(f'api_keys = ["a:{DIGEST}"]\n')
    monkeypatch.setenv("LANESTREAM_ALLOWED_ORIGINS", "https://Example.com:443, http://localhost:3000")
    found = load_settings(config=file)
    assert found.api_keys == (ApiKey("a", DIGEST),)
    assert found.allowed_origins == ("https://example.com", "http://localhost:3000")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("port = 'x'", "lanestream.toml: port = 'x': input should be a valid integer"),
        ("port = 70000", "lanestream.toml: port = 70000: input should be less than or equal to 65535"),
        ("prot = 1", "lanestream.toml: prot is not a setting (did you mean port? `lanestream serve"),
        ("quite_another = 1", "lanestream.toml: quite_another is not a setting (`lanestream serve"),
        ("config = 'x.toml'", "lanestream.toml: a settings file can't set config"),
        ("port =", "lanestream.toml is not valid TOML: "),
        ("api_keys = ['secret']", "lanestream.toml: api_keys: entry 1 is not a valid key; expected NAME:SHA256"),
        ("api_keys = [1]", "lanestream.toml: api_keys: expected a string or a list of strings"),
        ("allowed_origins = '*'", "lanestream.toml: allowed_origins = '*': '*' is not a valid origin"),
        ("allowed_origins = ['https://a.b/c']", "lanestream.toml: allowed_origins = ['https://a.b/c']: "),
    ],
)
def test_a_mistake_in_the_file_is_reported_on_one_line(file: Path, text: str, message: str) -> None:
    file.write_text(text)
    with pytest.raises(SettingsError) as caught:
        load_settings(config=file)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    ("data", "message"), [(None, "can't read .*: no such file"), (b"\xff\xfe", "is not a UTF-8 text file")]
)
def test_an_unreadable_file_is_reported(file: Path, data: bytes | None, message: str) -> None:
    if data is not None:
        file.write_bytes(data)
    with pytest.raises(SettingsError, match=message):
        load_settings(config=file)


def test_the_source_of_an_invalid_value_is_named(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file.write_text("port = 1\n")
    monkeypatch.setenv("LANESTREAM_PORT", "many")
    with pytest.raises(SettingsError, match=r"^LANESTREAM_PORT = 'many': "):
        load_settings(config=file)
    with pytest.raises(SettingsError, match=r"^--max-sessions = 0: "):
        load_settings(config=file, port=2, max_sessions=0)
    monkeypatch.setenv("LANESTREAM_API_KEYS", "a:secret")
    with pytest.raises(SettingsError, match=r"^LANESTREAM_API_KEYS: entry 1 is not a valid key") as caught:
        load_settings(port=1)
    assert "secret" not in str(caught.value)


def test_the_toml_output_has_all_settings_and_no_secret(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LANESTREAM_API_KEYS", f"camera-7:{DIGEST}")
    found = load_settings(port=1, host="::1", model=Path("m.onnx"), allowed_origins="https://a.b")
    text = to_toml(found)
    values = tomllib.loads(text)
    assert (values["port"], values["host"], values["model"]) == (1, "::1", "m.onnx")
    assert values["api_keys"] == ["camera-7:***"]
    assert values["allowed_origins"] == ["https://a.b"]
    assert "# regressor is not set" in text.splitlines()
    names = [line.removeprefix("# ").split()[0] for line in text.splitlines()]
    assert names == list(Settings.model_fields)
    for output in (text, repr(found), str(found)):
        assert DIGEST[:8] not in output


@pytest.mark.parametrize(
    ("name", "value"), [("PORT", "99999"), ("PROVIDER", "tpu"), ("THREADS", "0"), ("MAX_BYTES", "x")]
)
def test_an_invalid_variable_is_named(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(f"LANESTREAM_{name}", value)
    with pytest.raises(SettingsError, match=f"^LANESTREAM_{name} = '{value}': input should be") as caught:
        load_settings()
    assert "\n" not in str(caught.value)


def test_an_empty_variable_counts_as_not_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LANESTREAM_HOST", "")
    assert load_settings() == Settings()


@pytest.mark.parametrize(
    ("url", "masked"),
    [
        ("redis://host:6379/0", "redis://host:6379/0"),
        ("redis://user:secret@host/0", "redis://***@host/0"),
        ("rediss://:sec@ret@host:1", "rediss://***@host:1"),
        ("redis://host/0?password=secret", "redis://host/0?***"),
        ("redis://name:secret@host/0?password=secret", "redis://***@host/0?***"),
        ("rediss://secret@[2001:db8::1]:6379/15", "rediss://***@[2001:db8::1]:6379/15"),
        ("redis://name:sec/ret@host", "redis://***@host"),
        ("redis://name:sec ret@host", "redis://***@host"),
        # These may be read in more than one way.
        ("redis://name:sec?ret@host", "***"),
        ("redis://name:12?secret@host", "***"),
        ("redis://name:sec#ret@host", "***"),
        ("redis://host/0?password=sec@ret", "***"),
        ("redis://host/0#secret", "***"),
        ("redis://host/secret", "***"),
        ("redis://name:secret", "***"),
        ("redis://:123456789", "***"),
        ("name:secret@host:6379", "***"),
        (" redis://name:secret@host", "***"),
        ("secret", "***"),
    ],
)
def test_passwords_in_urls_are_masked(monkeypatch: pytest.MonkeyPatch, url: str, masked: str) -> None:
    monkeypatch.setenv("LANESTREAM_REDIS_URL", url)
    assert tomllib.loads(to_toml(load_settings()))["redis_url"] == masked


# Most characters are those that mean something in a URL. A password that is also in the rest of a URL may be shown.
PASSWORDS = st.text(st.sampled_from("@/?#:%[]. \n019ab") | st.characters(), min_size=4).filter(
    lambda text: text not in "rediss://***@host.example:6379/15?***"
)


@given(
    PASSWORDS,
    st.sampled_from(
        [
            "redis://name:{}@host.example:6379/15",
            "rediss://:{}@host.example",
            "redis://{}@host.example/15",
            "redis://host.example:6379/15?username=name&password={}",
            "redis://host.example#{}",
            "name:{}@host.example:6379",
            "{}",
        ]
    ),
)
def test_no_password_is_shown(password: str, url: str) -> None:
    shown = tomllib.loads(to_toml(Settings.model_construct(redis_url=SecretStr(url.format(password)))))["redis_url"]
    assert password not in shown


def test_the_operations_page_has_every_setting() -> None:
    rows = [line for line in OPERATIONS.read_text().splitlines() if line.startswith("| `LANESTREAM_")]
    assert rows == [_row(name) for name in Settings.model_fields]


def _row(name: str) -> str:
    field = Settings.model_fields[name]
    default = "the machine's" if field.default is PydanticUndefined else _shown(field.default)
    return f"| `LANESTREAM_{name.upper()}` | {default} | {field.description} |"


def _shown(default: object) -> str:
    if isinstance(default, tuple):
        return ", ".join(default)
    if isinstance(default, bool):
        return str(default).lower()
    return "" if default is None else f"{default:.12g}" if isinstance(default, int | float) else str(default)


def test_the_memory_for_images_must_hold_an_image_of_each_caller() -> None:
    assert load_settings(max_buffered_bytes=4 << 20, max_bytes=1 << 20).buffered_bytes == 4 << 20
    with pytest.raises(SettingsError, match=r"max_buffered_bytes = 4194303: .*use at least 4194304"):
        load_settings(max_buffered_bytes=(4 << 20) - 1, max_bytes=1 << 20)
