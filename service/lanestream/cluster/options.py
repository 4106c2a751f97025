"""What a deployment on a cluster needs besides the settings of the service, and the settings of its replicas."""

from __future__ import annotations

import math
import re
import secrets
from typing import TYPE_CHECKING, Final, Self

from pydantic import BaseModel, ConfigDict, Field, SecretStr, ValidationError

from lanestream.errors import SettingsError

if TYPE_CHECKING:
    from lanestream.settings import Settings

_RANGE: Final = re.compile(r"(\d{1,4})(?:\.\.(\d{1,4}))?", re.ASCII)
_SECRET_BYTES: Final = 32
# Ray's proxy closes a WebSocket whose client sends a larger message. uvicorn has this limit, and Ray does not set it.
_MOST_MESSAGE_BYTES: Final = 16 << 20


class ClusterOptions(BaseModel):
    """How many replicas there are, and what each of them reserves."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_replicas: int = Field(default=1, ge=1, le=9999, description="Minimum number of replicas.")
    max_replicas: int = Field(default=1, ge=1, le=9999, description="Maximum number of replicas.")
    sessions_per_replica: int = Field(
        default=4, ge=1, description="With more open streams per replica than this, on average, replicas are added."
    )
    cpus: float = Field(default=1.0, gt=0.0, le=1024.0, description="Processors that a replica reserves.")
    gpus: float = Field(default=0.0, ge=0.0, le=64.0, description="GPUs that a replica reserves.")
    upscale_delay_s: float = Field(
        default=5.0, ge=0.0, description="Replicas are added after too many streams for this many seconds."
    )
    downscale_delay_s: float = Field(
        default=300.0, ge=0.0, description="Replicas are removed after too few streams for this many seconds."
    )

    @classmethod
    def parse(cls, values: dict[str, object]) -> Self:
        """Returns the options in `values`. Raises SettingsError on one line that names the option."""
        try:
            options = cls.model_validate(values)
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            name = ".".join(str(part) for part in problem["loc"])
            if problem["type"] == "extra_forbidden":
                raise SettingsError(
                    f"{name} is not an option of a cluster", f"use {', '.join(cls.model_fields)}"
                ) from None
            message = problem["msg"][:1].lower() + problem["msg"][1:]
            raise SettingsError(f"{name} = {problem['input']!r}: {message}") from None
        if options.max_replicas < options.min_replicas:
            raise SettingsError(
                f"max_replicas = {options.max_replicas} is less than min_replicas = {options.min_replicas}",
                "raise max_replicas",
            )
        return options


def parse_replicas(text: str) -> tuple[int, int]:
    """Returns the minimum and maximum in `3` or `1..4`. Raises ValueError for any other text."""
    match = _RANGE.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is neither a number nor a range such as 1..4")
    least = int(match[1])
    return least, int(match[2] or least)


def check_settings(settings: Settings, options: ClusterOptions) -> None:
    """Raises SettingsError if these settings can't be used on a cluster."""
    if options.max_replicas > 1 and settings.redis_url is None:
        raise SettingsError(
            "more than one replica needs Redis, so that each can resume the sessions of the others",
            "set LANESTREAM_REDIS_URL, or use one replica",
        )
    if settings.tls_certificate is not None:
        raise SettingsError(
            "tls_certificate is set, and Ray's proxy does not use it", "unset it, and put a proxy with TLS in front"
        )
    if settings.max_bytes > _MOST_MESSAGE_BYTES:
        raise SettingsError(
            f"max_bytes = {settings.max_bytes}: Ray's proxy accepts no messages above {_MOST_MESSAGE_BYTES} bytes",
            f"use at most {_MOST_MESSAGE_BYTES}",
        )


def replica_settings(settings: Settings, options: ClusterOptions) -> Settings:
    """Returns the settings of the replicas. Missing ones follow from the processors that a replica reserves.

    Access tokens are signed with one secret on all replicas. /metrics is off: a request gets to any one replica.
    """
    cpus = math.ceil(options.cpus)
    processes = settings.processes
    if processes is None:
        # Networks on a GPU get one process, in which the requests of all cameras meet.
        processes = 1 if options.gpus else cpus
    single = processes <= 1
    secret = settings.token_secret or SecretStr(secrets.token_urlsafe(_SECRET_BYTES))
    return settings.model_copy(
        update={
            "processes": processes,
            "threads": settings.threads or (cpus + 1 if single else 1),
            "inference_threads": settings.inference_threads or (max(1, cpus // 2) if single else 1),
            "token_secret": secret,
            "metrics_access": "off",
        }
    )
