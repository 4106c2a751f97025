"""The settings of the service: from the command line, from environment variables LANESTREAM_..., or from a TOML file.

The command line takes precedence over the environment, and the environment over the file.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, get_args

from pydantic import AfterValidator, BeforeValidator, Field, SecretStr, ValidationError
from pydantic_settings import (
    BaseSettings,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from lanestream.errors import SettingsError, one_line
from lanestream.host import memory, network_threads, processors
from lanestream.images.decoding import MOST_PIXELS, ImageLimits
from lanestream.inference.providers import AUTO, PROVIDER_NAMES, RuntimeOptions
from lanestream.keys import ApiKey, parse_keys
from lanestream.road.appearance import BOUNDARY_KINDS, BoundaryKind
from lanestream.streaming.session_registry import SessionLimits
from lanestream.streaming.stream_protocol import StreamLimits
from lanestream.tracking.departure import DepartureSettings

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

_PREFIX: Final = "LANESTREAM_"
# Variables of other programs: the client's key, the data for training, what compose.yaml publishes.
_OTHER_VARIABLES: Final = frozenset({"LANESTREAM_API_KEY", "LANESTREAM_DATA", "LANESTREAM_PUBLISH"})
# What Kubernetes sets for Services named "lanestream" or "lanestream-...", with its value.
_KUBERNETES_VARIABLE: Final = re.compile(
    r"LANESTREAM_(\w+_)?(SERVICE_(HOST|PORT\w*)|PORT_\d+_\w+)=.*|LANESTREAM_\w+_PORT=(tcp|udp|sctp)://.*", re.DOTALL
)
_ORIGIN: Final = re.compile(r"[a-z][a-z0-9+.-]*://[^/\s*?#@]+")
_MASK: Final = "***"
_MOST_BUFFERED_BYTES: Final = 256 << 20
_FEWEST_CONNECTIONS: Final = 1024
# Room for the single requests of an address that has all its sessions open.
_CONNECTIONS_BESIDE_SESSIONS: Final = 64
# A Redis URL in which only what is before the last @ and the query may be secret. A ? or # in a password looks like the
# start of a query or a fragment, so this matches no URL in which an @ follows one of them.
_REDIS_URL: Final = re.compile(
    r"(?P<scheme>rediss?://)(?P<user>[^?#]*@)?"
    r"(?P<address>([\w.-]+|\[[\dA-Fa-f:.]+\])(:\d{1,5})?(/\d{0,3})?)(?P<query>\?[^@]*)?",
    re.ASCII,
)


def _keys(value: object) -> object:
    """Returns the keys in a string, separated by commas or lines, or in a list of such strings."""
    return parse_keys(_split(value), "entry") if value else ()


def _origins(value: object) -> object:
    """Returns the origins in a string, separated by commas or lines, or in a list of such strings."""
    origins = tuple(text.lower() for text in _split(value) if text)
    for origin in origins:
        if not _ORIGIN.fullmatch(origin):
            raise ValueError(f"{origin!r} is not a valid origin; expected scheme://host or scheme://host:port")
    return tuple(_without_default_port(origin) for origin in origins)


def _names(value: object) -> object:
    """Returns the names in a string, separated by commas or lines, or in a list of such strings."""
    return tuple(name for name in _split(value) if name)


def _without_default_port(origin: str) -> str:
    """Returns the origin as browsers send it, without the default port of its scheme."""
    for scheme, port in (("http://", ":80"), ("https://", ":443")):
        if origin.startswith(scheme):
            return origin.removesuffix(port)
    return origin


def _split(value: object) -> list[str]:
    """Returns the parts of a string, or of a list of strings, separated by commas or lines."""
    values = value if isinstance(value, list | tuple) else [value]
    texts = [text for text in values if isinstance(text, str)]
    if len(texts) < len(values):
        raise ValueError("expected a string or a list of strings")
    return [part.strip() for text in texts for line in text.splitlines() for part in line.split(",")]


def _provider(name: str) -> str:
    """Returns the name of an execution provider, or `auto`. Raises ValueError for any other."""
    if name not in PROVIDER_NAMES:
        raise ValueError(f"input should be one of {', '.join(PROVIDER_NAMES)}")
    return name


class Settings(BaseSettings):
    """The settings of the service. Each is read from LANESTREAM_<NAME>, or by its name from the file `config`."""

    model_config = SettingsConfigDict(
        env_prefix=_PREFIX, env_ignore_empty=True, frozen=True, extra="forbid", hide_input_in_errors=True
    )

    config: Path | None = Field(default=None, description="TOML file with settings.")

    host: str = Field(default="127.0.0.1", min_length=1, description="Address to listen on.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen on; 0 selects a free one.")
    tls_certificate: Path | None = Field(
        default=None, description="PEM file with the certificate for https and its chain; without it, http is spoken."
    )
    tls_key: Path | None = Field(
        default=None, description="PEM file with the private key of the certificate, if it is not in the same file."
    )
    model: Path | None = Field(default=None, description="ONNX file of the network, or `shipped`, the default.")
    regressor: Path | None = Field(
        default=None, description="ONNX file of the regressor, `shipped`, the default, or `none`."
    )
    provider: Annotated[str, AfterValidator(_provider)] = Field(
        default=AUTO, description="Execution provider of the networks."
    )
    inference_threads: int | None = Field(
        default=None,
        ge=1,
        le=256,
        description="CPU threads for one run of a network; if not set, 1, or half of the processors with a single "
        "process.",
    )
    tensorrt_cache: Path | None = Field(default=None, description="Folder where TensorRT caches the engines it builds.")
    max_bytes: int = Field(default=8 << 20, ge=1024, le=1 << 28, description="Maximum size of an image file in bytes.")
    max_pixels: int = Field(
        default=4096 * 2304, ge=1 << 16, le=MOST_PIXELS, description="Maximum number of pixels of an image."
    )
    max_sessions: int = Field(default=64, ge=1, description="Maximum number of concurrent streams and single images.")
    max_sessions_per_caller: int | None = Field(
        default=None,
        ge=1,
        description="Maximum number of concurrent sessions per key, or per host without keys; if not set, half of "
        "max_sessions.",
    )
    max_connections: int | None = Field(
        default=None,
        ge=2,
        description="Maximum number of TCP connections; if not set, twice max_sessions, at least 1024.",
    )
    max_connections_per_address: int | None = Field(
        default=None,
        ge=1,
        description="Maximum number of TCP connections of one address that is not a trusted proxy; if not set, a "
        "quarter of max_connections, and more than max_sessions_per_caller.",
    )
    max_buffered_bytes: int | None = Field(
        default=None,
        ge=1 << 20,
        description="Memory in bytes for received images and unsent pictures, a quarter of it for one caller; if not "
        "set, "
        "an eighth of the memory, at most 256 MB.",
    )
    credits: int = Field(
        default=8, ge=1, le=256, description="Maximum number of unanswered frames of a stream in mode `all`."
    )
    frames_per_s: float = Field(
        default=240.0, gt=0.0, description="Maximum average number of frames per second of a stream."
    )
    bytes_per_s: float = Field(
        default=256e6, gt=0.0, description="Maximum average number of bytes per second of a stream."
    )
    frame_deadline_s: float = Field(
        default=2.0, gt=0.0, description="In mode `latest`, a frame that waited this many seconds is dropped."
    )
    handshake_s: float = Field(
        default=10.0,
        gt=0.0,
        description="Time limit in seconds for the head of a request, and for the first message of a stream.",
    )
    body_s: float = Field(default=30.0, gt=0.0, description="Time limit in seconds for the body of a single request.")
    send_s: float = Field(
        default=10.0, gt=0.0, description="A peer that reads nothing for this many seconds is disconnected."
    )
    idle_s: float = Field(default=60.0, gt=0.0, description="A stream that is idle for this many seconds is closed.")
    session_s: float = Field(
        default=86_400.0, gt=0.0, description="Maximum age of a session in seconds, over all its sockets."
    )
    resume_s: float = Field(
        default=60.0, ge=1.0, description="A session can be resumed for this many seconds after its socket closed."
    )
    drain_s: float = Field(
        default=10.0, ge=0.0, description="Before a stop, frames are answered for at most this many seconds."
    )
    redis_url: SecretStr | None = Field(
        default=None,
        description="Redis that stores sessions for all replicas, redis://host:6379/0; in memory if not set.",
    )
    processes: int | None = Field(
        default=None,
        ge=0,
        le=64,
        description="Worker processes, or 0 to process frames in the service's own; if not set, one per processor, at "
        "most 8 and as many as fit into memory, and one if a GPU runs the networks.",
    )
    threads: int | None = Field(
        default=None,
        ge=1,
        le=256,
        description="Frames that each process handles concurrently, one thread each; if not set, 1, or one more than "
        "there are processors with a single process.",
    )
    opencv_threads: int = Field(default=1, ge=1, le=256, description="Threads that OpenCV uses for one image.")

    kinds: Annotated[tuple[BoundaryKind, ...], NoDecode, BeforeValidator(_names)] = Field(
        default=BOUNDARY_KINDS,
        min_length=1,
        description="The kinds of boundaries to report, `marking`, `road_edge` or both, if a request does not say it.",
    )
    camera: Path | None = Field(
        default=None, description="Camera file for streams and images that send no camera; without it, none is assumed."
    )
    departure_vehicle_width: float = Field(
        default=DepartureSettings.vehicle_width,
        ge=0.5,
        le=4.0,
        description="Width of a vehicle in meters, over the outer edges of its wheels, if `start` does not say it.",
    )
    departure_warning_s: float = Field(
        default=DepartureSettings.warning_s,
        ge=0.0,
        le=5.0,
        description="A lane departure warning comes this many seconds before the wheels cross a line.",
    )
    departure_least_speed: float = Field(
        default=DepartureSettings.least_speed,
        ge=0.0,
        le=150.0,
        description="Below this speed in m/s, if a vehicle reports it, no lane departure warning comes.",
    )

    api_keys: Annotated[tuple[ApiKey, ...], NoDecode, BeforeValidator(_keys)] = Field(
        default=(),
        description="API keys as printed by `lanestream key NAME`, NAME:SHA256; without any, every caller is accepted.",
    )
    api_keys_file: Path | None = Field(default=None, description="File with further API keys, one per line.")
    token_secret: SecretStr | None = Field(
        default=None,
        min_length=32,
        description="Secret of at least 32 characters that signs access tokens, the same on all replicas; if not set, "
        "a random one, so that tokens are valid only for this process.",
    )
    token_s: float = Field(
        default=600.0, ge=10.0, le=3600.0, description="Access tokens for web pages expire after this many seconds."
    )
    allowed_origins: Annotated[tuple[str, ...], NoDecode, BeforeValidator(_origins)] = Field(
        default=(), description="Origins of other web pages that may use the service, such as https://example.com."
    )
    live_page: bool = Field(default=True, description="Serve the live page at `/`.")
    metrics_access: Literal["keys", "open", "off"] = Field(
        default="keys", description="Who may read /metrics: `keys` callers with a key, `open` everyone, `off` no one."
    )
    log_format: Literal["text", "json"] = Field(default="text", description="Format of log records.")
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="Lowest level that is logged."
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
        """Returns the sources of settings, in order of precedence."""
        return init_settings, env_settings, TomlConfigSettingsSource(settings_cls)

    @property
    def runtime_options(self) -> RuntimeOptions:
        """The runtime options of the networks."""
        # A single process leaves processors to the other stages of frames; several processes have one processor each.
        default = network_threads() if self.processes in (0, 1) else 1
        return RuntimeOptions(self.inference_threads or default, self.tensorrt_cache)

    def threads_per_process(self, processes: int) -> int:
        """Returns the number of frames that each of `processes` processes handles concurrently."""
        return self.threads or (1 if processes > 1 else processors() + 1)

    @property
    def connections(self) -> int:
        """The maximum number of TCP connections."""
        return self.max_connections or max(_FEWEST_CONNECTIONS, 2 * self.max_sessions)

    @property
    def connections_per_address(self) -> int:
        """The maximum number of TCP connections of one address."""
        default = max(self.connections // 4, self.sessions_per_caller + _CONNECTIONS_BESIDE_SESSIONS)
        return min(self.max_connections_per_address or default, self.connections)

    @property
    def sessions_per_caller(self) -> int:
        """The maximum number of sessions of one caller."""
        return self.max_sessions_per_caller or max(1, self.max_sessions // 2)

    @property
    def buffered_bytes(self) -> int:
        """The memory for received images and unsent pictures in bytes."""
        if self.max_buffered_bytes is not None:
            return self.max_buffered_bytes
        # A caller gets a quarter of it, and any accepted message must fit into that.
        return max(min(_MOST_BUFFERED_BYTES, int(memory() / 8)), 8 * self.max_bytes)

    @property
    def session_limits(self) -> SessionLimits:
        """The limits of all sessions."""
        return SessionLimits(
            sessions=self.max_sessions,
            sessions_per_caller=self.sessions_per_caller,
            session_s=self.session_s,
            resume_s=self.resume_s,
            idle_s=self.idle_s,
        )

    @property
    def stream_limits(self) -> StreamLimits:
        """The limits of one stream."""
        return StreamLimits(
            credits=self.credits,
            frames_per_s=self.frames_per_s,
            bytes_per_s=self.bytes_per_s,
            frame_deadline_s=self.frame_deadline_s,
            handshake_s=self.handshake_s,
            idle_s=self.idle_s,
        )

    @property
    def departure_settings(self) -> DepartureSettings:
        """When to warn of lane departures, unless a stream says otherwise."""
        return DepartureSettings(self.departure_vehicle_width, self.departure_warning_s, self.departure_least_speed)

    @property
    def image_limits(self) -> ImageLimits:
        """The limits of one image."""
        return ImageLimits(max_bytes=self.max_bytes, max_pixels=self.max_pixels)


def load_settings(**options: object) -> Settings:
    """Returns the settings from command-line `options` (None means not given), the environment and the file `config`.

    Raises SettingsError on one line that names the option, the variable or the key in the file, and shows no secret.
    """
    _check_variables()
    given: dict[str, Any] = {name: value for name, value in options.items() if value is not None}
    config = given.get("config") or os.environ.get(f"{_PREFIX}CONFIG")
    path = None if config is None or config == "" else Path(str(config))
    file_values = {} if path is None else _read_toml(path)

    class FileSettings(Settings):
        """Settings that are also read from this file."""

        model_config = SettingsConfigDict(toml_file=path)

    try:
        settings = Settings.model_construct(**dict(FileSettings(**given)))
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        name = str(problem["loc"][0])
        if name in given:
            label = f"--{name.replace('_', '-')}"
        elif name in file_values and not os.environ.get(_PREFIX + name.upper()):
            label = f"{path}: {name}"
        else:
            label = _PREFIX + name.upper()
        raise _settings_error(label, problem) from None
    if settings.tls_key is not None and settings.tls_certificate is None:
        raise SettingsError("tls_key is set and tls_certificate is not", "set both, or neither")
    least = 4 * settings.max_bytes
    if settings.buffered_bytes < least:
        raise SettingsError(
            f"max_buffered_bytes = {settings.buffered_bytes}: a caller's quarter can't hold one image of max_bytes",
            f"use at least {least}, or lower max_bytes",
        )
    return settings


def _check_variables() -> None:
    """Raises SettingsError if an environment variable has the prefix of the settings and is not one of them."""
    for variable, value in os.environ.items():
        full_name = variable.upper()
        name = full_name.removeprefix(_PREFIX).lower()
        if name in Settings.model_fields or full_name in _OTHER_VARIABLES or not full_name.startswith(_PREFIX):
            continue
        if not _KUBERNETES_VARIABLE.fullmatch(f"{variable}={value}"):
            nearest = _nearest_setting(name)
            raise _unknown_setting(
                f"the environment variable {one_line(variable, 80)}", nearest and _PREFIX + nearest.upper()
            )
    if os.environ.get("LANESTREAM_PORT", "").startswith("tcp://"):
        raise SettingsError(
            "LANESTREAM_PORT is the address that Kubernetes sets for a Service named lanestream",
            "set enableServiceLinks: false for the pod, or give the Service another name",
        )


def _nearest_setting(name: str) -> str | None:
    return next(iter(get_close_matches(name, Settings.model_fields, n=1)), None)


def _unknown_setting(label: str, nearest: str | None) -> SettingsError:
    hint = f"did you mean {nearest}? " if nearest else ""
    return SettingsError(f"{label} is not a setting", f"{hint}`lanestream serve --print-config` lists all settings")


def to_toml(settings: Settings) -> str:
    """Returns the settings as TOML, one per line, with secrets masked. Settings without a value are comments."""
    lines = (_toml_line(name, getattr(settings, name)) for name in type(settings).model_fields)
    return "\n".join(lines)


def _read_toml(path: Path) -> dict[str, Any]:
    """Returns the keys and values of a TOML file. Raises SettingsError if it can't be read or is not valid."""
    try:
        with path.open("rb") as file:
            values = tomllib.load(file)
    except OSError as error:
        raise SettingsError(
            f"can't read {path}: {(error.strerror or str(error)).lower()}", "check --config and LANESTREAM_CONFIG"
        ) from None
    except UnicodeDecodeError:
        raise SettingsError(f"{path} is not a UTF-8 text file", "use a TOML file") from None
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(
            f"{path} is not valid TOML: {_lower_first(str(error))}", 'write a setting as `name = "value"`'
        ) from None
    if "config" in values:
        raise SettingsError(f"{path}: a settings file can't set config", "use one file, named by --config")
    return values


def _settings_error(label: str, problem: ErrorDetails) -> SettingsError:
    if problem["type"] == "extra_forbidden":
        return _unknown_setting(label, _nearest_setting(str(problem["loc"][0])))
    message = _lower_first(problem["msg"].removeprefix("Value error, "))
    return SettingsError(f"{label}{_input(problem)}: {message}")


def _input(problem: ErrorDetails) -> str:
    """Returns the rejected value for an error message; nothing for a secret."""
    annotation = Settings.model_fields[str(problem["loc"][0])].annotation
    secret = {annotation, *get_args(annotation)} & {SecretStr, ApiKey}
    return "" if secret else f" = {problem['input']!r}"


def _toml_line(name: str, value: object) -> str:
    if value is None:
        return f"# {name} is not set"
    return f"{name} = {json.dumps(_plain(value), ensure_ascii=False)}"


def _plain(value: object) -> object:
    """Returns a value that JSON writes as TOML does, with secrets masked."""
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, ApiKey):
        return f"{value.name}:{_MASK}"
    if isinstance(value, SecretStr):
        return _masked_url(value.get_secret_value())
    return str(value) if isinstance(value, Path) else value


def _masked_url(url: str) -> str:
    """Returns a Redis URL with its secrets masked; any other text, which may be secret as a whole, is masked whole."""
    match = _REDIS_URL.fullmatch(url)
    if match is None:
        return _MASK
    user, query = match["user"] and f"{_MASK}@", match["query"] and f"?{_MASK}"
    return f"{match['scheme']}{user or ''}{match['address']}{query or ''}"


def _lower_first(message: str) -> str:
    return message[:1].lower() + message[1:]
