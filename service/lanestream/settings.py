"""What can be set about the service: on the command line, by environment variables LANESTREAM_..., or in a TOML file.

Of what is set in more than one place the command line counts first, then the environment, then the file.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, get_args

from pydantic import BeforeValidator, Field, SecretStr, ValidationError
from pydantic_settings import (
    BaseSettings,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from lanestream.errors import SettingsError
from lanestream.host import network_threads, processors
from lanestream.images.decoding import MOST_PIXELS, ImageLimits
from lanestream.keys import ApiKey, parse_keys
from lanestream.runtime import Provider, RuntimeOptions
from lanestream.streaming.session_registry import SessionLimits
from lanestream.streaming.stream_protocol import StreamLimits

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

_PREFIX: Final = "LANESTREAM_"
_ORIGIN: Final = re.compile(r"[a-z][a-z0-9+.-]*://[^/\s*?#@]+")
_MASK: Final = "***"
# Where a URL may have a password: before its host, or among its parameters.
_URL_SECRETS: Final = re.compile(r"(?<=://)[^/\s]+(?=@)|(?<=\?).+")


def _keys(value: object) -> object:
    """The keys in a text of them, separated by commas or lines, or in a list of such texts."""
    return parse_keys(_texts(value), "entry") if value else ()


def _origins(value: object) -> object:
    """The origins in a text of them, separated by commas or lines, or in a list of such texts."""
    origins = tuple(text.lower() for text in _texts(value) if text)
    for origin in origins:
        if not _ORIGIN.fullmatch(origin):
            raise ValueError(f"{origin!r} is no origin; scheme://host or scheme://host:port is accepted")
    return tuple(_without_default_port(origin) for origin in origins)


def _without_default_port(origin: str) -> str:
    """The origin as browsers tell it."""
    for scheme, port in (("http://", ":80"), ("https://", ":443")):
        if origin.startswith(scheme):
            return origin.removesuffix(port)
    return origin


def _texts(value: object) -> list[str]:
    given = value if isinstance(value, list | tuple) else [value]
    texts = [text for text in given if isinstance(text, str)]
    if len(texts) < len(given):
        raise ValueError("a text or a list of texts is accepted")
    return [part.strip() for text in texts for line in text.splitlines() for part in line.split(",")]


class Settings(BaseSettings):
    """The service's settings; each is read from LANESTREAM_<NAME>, or by its name from the file that `config` names."""

    model_config = SettingsConfigDict(
        env_prefix=_PREFIX, env_ignore_empty=True, frozen=True, extra="forbid", hide_input_in_errors=True
    )

    config: Path | None = Field(default=None, description="TOML file with settings; it can't name another one.")

    host: str = Field(default="127.0.0.1", min_length=1, description="Address to listen on.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    model: Path | None = Field(default=None, description="ONNX file of the network; the shipped one where absent.")
    regressor: Path | None = Field(
        default=None, description="ONNX file of the second network, or `none`; the shipped one where absent."
    )
    provider: Provider = Field(default="auto", description="Where the networks run.")
    inference_threads: int | None = Field(
        default=None,
        ge=1,
        le=256,
        description="Threads of one network's run on the CPU; if absent 1, or half of the processors in one process.",
    )
    tensorrt_cache: Path | None = Field(default=None, description="Folder where TensorRT keeps the engines it builds.")
    max_bytes: int = Field(default=8 << 20, ge=1024, le=1 << 28, description="Bytes of one image file at most.")
    max_pixels: int = Field(default=4096 * 2304, ge=1 << 16, le=MOST_PIXELS, description="Pixels of one image at most.")
    max_sessions: int = Field(default=64, ge=1, description="Streams and single images at a time at most.")
    max_sessions_per_caller: int | None = Field(
        default=None, ge=1, description="Sessions of one key, or of one host without keys, at a time at most."
    )
    credits: int = Field(default=8, ge=1, le=256, description="Unanswered frames of a stream in mode `all` at most.")
    frames_per_s: float = Field(default=240.0, gt=0.0, description="Frames a second of a stream at most, on average.")
    bytes_per_s: float = Field(default=256e6, gt=0.0, description="Bytes a second of a stream at most, on average.")
    frame_deadline_s: float = Field(
        default=2.0, gt=0.0, description="In mode `latest` a frame that waited so long is dropped."
    )
    handshake_s: float = Field(
        default=10.0,
        gt=0.0,
        description="The head of a request, and the first message of a stream, come within this time.",
    )
    body_s: float = Field(default=30.0, gt=0.0, description="A single image has to come within this time.")
    idle_s: float = Field(default=60.0, gt=0.0, description="A stream from which nothing comes for so long is closed.")
    session_s: float = Field(default=86_400.0, gt=0.0, description="A session's longest life, over all its sockets.")
    resume_s: float = Field(default=60.0, ge=1.0, description="A session can be resumed so long after its last socket.")
    drain_s: float = Field(default=10.0, ge=0.0, description="Before a stop, frames are answered for so long at most.")
    redis_url: SecretStr | None = Field(
        default=None,
        description="Redis that keeps sessions for all replicas, redis://host:6379/0; in memory if absent.",
    )
    processes: int | None = Field(
        default=None,
        ge=0,
        le=64,
        description="Processes that work on frames, 0 for the service's own alone; if absent one for each processor, "
        "8 at most and no more than there is memory for, and one where a GPU runs the networks.",
    )
    threads: int | None = Field(
        default=None,
        ge=1,
        le=256,
        description="Frames that each process has in work at a time, a thread each; if absent 1, or in one process one "
        "more than there are processors.",
    )
    opencv_threads: int = Field(default=1, ge=1, le=256, description="Threads that OpenCV takes for one image.")

    api_keys: Annotated[tuple[ApiKey, ...], NoDecode, BeforeValidator(_keys)] = Field(
        default=(), description="API keys as `lanestream key NAME` prints them, NAME:SHA256; without any, all may come."
    )
    api_keys_file: Path | None = Field(default=None, description="File with more of them, one a line.")
    allowed_origins: Annotated[tuple[str, ...], NoDecode, BeforeValidator(_origins)] = Field(
        default=(), description="Origins of web pages that may use the service, beside its own: https://example.com."
    )
    metrics_access: Literal["keys", "open", "off"] = Field(
        default="keys", description="Who may read /metrics: those with a key, everybody, nobody."
    )
    log_format: Literal["text", "json"] = Field(default="text", description="Form of a line in the log.")
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="The least that is logged."
    )

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,  # noqa: ARG003
        file_secret_settings: PydanticBaseSettingsSource,  # noqa: ARG003
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Where settings come from, the first counts."""
        return init_settings, env_settings, TomlConfigSettingsSource(settings_cls)

    @property
    def runtime_options(self) -> RuntimeOptions:
        """How the networks run."""
        # In one process a run leaves room for the frames beside it; among several each has its own processor.
        usual = network_threads() if self.processes in (0, 1) else 1
        return RuntimeOptions(self.inference_threads or usual, self.tensorrt_cache)

    def threads_of(self, processes: int) -> int:
        """Frames in work at a time in each of so many processes."""
        return self.threads or (1 if processes > 1 else processors() + 1)

    @property
    def session_limits(self) -> SessionLimits:
        """How many sessions there may be, and for how long."""
        return SessionLimits(
            sessions=self.max_sessions,
            sessions_per_caller=self.max_sessions_per_caller,
            session_s=self.session_s,
            resume_s=self.resume_s,
            idle_s=self.idle_s,
        )

    @property
    def stream_limits(self) -> StreamLimits:
        """What one stream may do."""
        return StreamLimits(
            credits=self.credits,
            frames_per_s=self.frames_per_s,
            bytes_per_s=self.bytes_per_s,
            frame_deadline_s=self.frame_deadline_s,
            handshake_s=self.handshake_s,
            idle_s=self.idle_s,
        )

    @property
    def image_limits(self) -> ImageLimits:
        """The limits of one image."""
        return ImageLimits(max_bytes=self.max_bytes, max_pixels=self.max_pixels)


def load_settings(**given: object) -> Settings:
    """Settings as `given` on the command line (None counts as not given), else from the environment, else from a file.

    The file is the one that the setting `config` names. Raises SettingsError with one line that names the option, the
    variable or the key in the file, and shows no secret.
    """
    chosen: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    named = chosen.get("config") or os.environ.get(f"{_PREFIX}CONFIG")
    path = None if named is None or named == "" else Path(str(named))
    keys = {} if path is None else _read(path)

    class Configured(Settings):
        """The settings, with this file behind them."""

        model_config = SettingsConfigDict(toml_file=path)

    try:
        return Settings.model_construct(**dict(Configured(**chosen)))
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        name = str(problem["loc"][0])
        if name in chosen:
            label = f"--{name.replace('_', '-')}"
        elif name in keys and not os.environ.get(_PREFIX + name.upper()):
            label = f"{path}: {name}"
        else:
            label = _PREFIX + name.upper()
        raise _told(label, problem) from None


def shown(settings: Settings) -> str:
    """The settings as a TOML file, one a line, without the secrets in them; what is not set is a comment."""
    lines = (_line(name, getattr(settings, name)) for name in type(settings).model_fields)
    return "\n".join(lines)


def _read(path: Path) -> dict[str, Any]:
    """The keys and values of a TOML file. Raises SettingsError where it is none."""
    try:
        with path.open("rb") as file:
            values = tomllib.load(file)
    except OSError as error:
        raise SettingsError(
            f"can't read {path}: {(error.strerror or str(error)).lower()}", "see --config and LANESTREAM_CONFIG"
        ) from None
    except UnicodeDecodeError:
        raise SettingsError(f"{path} is no text", "give a TOML file") from None
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(
            f"{path} is no TOML: {_sentence(str(error))}", 'write a setting as `name = "value"`'
        ) from None
    if "config" in values:
        raise SettingsError(f"{path}: config can't be set in the file", "give one file, with --config")
    return values


def _told(label: str, problem: ErrorDetails) -> SettingsError:
    if problem["type"] == "extra_forbidden":
        return SettingsError(f"{label} is no setting", "`lanestream serve --print-config` prints all there are")
    message = _sentence(problem["msg"].removeprefix("Value error, "))
    return SettingsError(f"{label}{_value(problem)}: {message}")


def _value(problem: ErrorDetails) -> str:
    """What was given, where it may be seen."""
    annotation = Settings.model_fields[str(problem["loc"][0])].annotation
    secret = {annotation, *get_args(annotation)} & {SecretStr, ApiKey}
    return "" if secret else f" = {problem['input']!r}"


def _line(name: str, value: object) -> str:
    if value is None:
        return f"# {name} is not set"
    return f"{name} = {json.dumps(_plain(value), ensure_ascii=False)}"


def _plain(value: object) -> object:
    """A value as TOML and JSON both write it, without its secrets."""
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    if isinstance(value, ApiKey):
        return f"{value.name}:{_MASK}"
    if isinstance(value, SecretStr):
        return _URL_SECRETS.sub(_MASK, value.get_secret_value())
    return str(value) if isinstance(value, Path) else value


def _sentence(message: str) -> str:
    return message[:1].lower() + message[1:]
