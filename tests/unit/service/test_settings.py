"""Settings from the command line, the environment and a file."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest
from pydantic_core import PydanticUndefined

from lanestream.errors import SettingsError
from lanestream.keys import ApiKey
from lanestream.settings import Settings, load_settings, shown

OPERATIONS = Path(__file__).parents[3] / "docs" / "operations.md"
DIGEST = "0123456789abcdef" * 4


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return Path("lanestream.toml")


def test_the_command_line_counts_before_the_environment_and_that_before_the_file(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.write_text('port = 1\nhost = "::1"\ncredits = 2\nmodel = "m.onnx"\n')
    monkeypatch.setenv("LANESTREAM_PORT", "3")
    monkeypatch.setenv("LANESTREAM_HOST", "::2")
    monkeypatch.setenv("LANESTREAM_CREDITS", "")
    found = load_settings(config=file, port=4, host=None)
    assert (found.port, found.host, found.credits, found.model) == (4, "::2", 2, Path("m.onnx"))
    assert found.max_bytes == Settings().max_bytes


def test_the_file_can_be_named_by_a_variable(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_keys_are_a_text_or_a_list(value: Any) -> None:
    assert load_settings(api_keys=value).api_keys == (ApiKey("a", DIGEST), ApiKey("b", DIGEST))


def test_lists_come_from_variables_and_from_a_file(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file.write_text(f'api_keys = ["a:{DIGEST}"]\n')
    monkeypatch.setenv("LANESTREAM_ALLOWED_ORIGINS", "https://Example.com:443, http://localhost:3000")
    found = load_settings(config=file)
    assert found.api_keys == (ApiKey("a", DIGEST),)
    assert found.allowed_origins == ("https://example.com", "http://localhost:3000")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("port = 'x'", "lanestream.toml: port = 'x': input should be a valid integer"),
        ("port = 70000", "lanestream.toml: port = 70000: input should be less than or equal to 65535"),
        ("prot = 1", "lanestream.toml: prot is no setting ("),
        ("config = 'x.toml'", "lanestream.toml: config can't be set in the file"),
        ("port =", "lanestream.toml is no TOML: "),
        ("api_keys = ['secret']", "lanestream.toml: api_keys: entry 1 is no key; NAME:SHA256 is expected"),
        ("api_keys = [1]", "lanestream.toml: api_keys: a text or a list of texts is accepted"),
        ("allowed_origins = '*'", "lanestream.toml: allowed_origins = '*': '*' is no origin"),
        ("allowed_origins = ['https://a.b/c']", "lanestream.toml: allowed_origins = ['https://a.b/c']: "),
    ],
)
def test_a_mistake_in_the_file_is_told_in_a_line(file: Path, text: str, said: str) -> None:
    file.write_text(text)
    with pytest.raises(SettingsError) as caught:
        load_settings(config=file)
    assert str(caught.value).startswith(said)
    assert "\n" not in str(caught.value)
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(("data", "said"), [(None, "can't read .*: no such file"), (b"\xff\xfe", "is no text")])
def test_a_file_that_can_not_be_read_is_told(file: Path, data: bytes | None, said: str) -> None:
    if data is not None:
        file.write_bytes(data)
    with pytest.raises(SettingsError, match=said):
        load_settings(config=file)


def test_the_place_of_a_mistake_is_named(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file.write_text("port = 1\n")
    monkeypatch.setenv("LANESTREAM_PORT", "many")
    with pytest.raises(SettingsError, match=r"^LANESTREAM_PORT = 'many': "):
        load_settings(config=file)
    with pytest.raises(SettingsError, match=r"^--max-sessions = 0: "):
        load_settings(config=file, port=2, max_sessions=0)
    monkeypatch.setenv("LANESTREAM_API_KEYS", "a:secret")
    with pytest.raises(SettingsError, match=r"^LANESTREAM_API_KEYS: entry 1 is no key") as caught:
        load_settings(port=1)
    assert "secret" not in str(caught.value)


def test_what_is_shown_is_a_file_with_all_settings_and_no_secret(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LANESTREAM_API_KEYS", f"camera-7:{DIGEST}")
    found = load_settings(port=1, host="::1", model=Path("m.onnx"), allowed_origins="https://a.b")
    text = shown(found)
    values = tomllib.loads(text)
    assert (values["port"], values["host"], values["model"]) == (1, "::1", "m.onnx")
    assert values["api_keys"] == ["camera-7:***"]
    assert values["allowed_origins"] == ["https://a.b"]
    assert "# regressor is not set" in text.splitlines()
    names = [line.removeprefix("# ").split()[0] for line in text.splitlines()]
    assert names == list(Settings.model_fields)
    for secret_safe in (text, repr(found), str(found)):
        assert DIGEST[:8] not in secret_safe


@pytest.mark.parametrize(
    ("url", "told"),
    [
        ("redis://host:6379/0", "redis://host:6379/0"),
        ("redis://user:secret@host/0", "redis://***@host/0"),
        ("rediss://:sec@ret@host:1", "rediss://***@host:1"),
        ("redis://host/0?password=secret", "redis://host/0?***"),
    ],
)
def test_passwords_in_urls_are_masked(monkeypatch: pytest.MonkeyPatch, url: str, told: str) -> None:
    monkeypatch.setenv("LANESTREAM_REDIS_URL", url)
    assert tomllib.loads(shown(load_settings()))["redis_url"] == told


def test_the_manual_has_every_setting() -> None:
    """The table of settings in the manual; a row that is missing is printed as it has to be."""
    rows = [line for line in OPERATIONS.read_text().splitlines() if line.startswith("| `LANESTREAM_")]
    assert rows == [_row(name) for name in Settings.model_fields]


def _row(name: str) -> str:
    field = Settings.model_fields[name]
    default = "the machine's" if field.default is PydanticUndefined else _told(field.default)
    return f"| `LANESTREAM_{name.upper()}` | {default} | {field.description} |"


def _told(default: object) -> str:
    return "" if default in (None, ()) else f"{default:.12g}" if isinstance(default, int | float) else str(default)
