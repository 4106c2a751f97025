"""What can be set about the service: by environment variables with the prefix LANESTREAM_, or on the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field, SecretStr, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict

from lanestream.errors import SettingsError
from lanestream.imaging import MOST_PIXELS, ImageLimits
from lanestream.processors import processors
from lanestream.runtime import Provider, RuntimeOptions
from lanestream.sessions.manager import SessionLimits
from lanestream.sessions.stream_rules import StreamLimits

_PREFIX = "LANESTREAM_"


class Settings(BaseSettings):
    """The service's settings; each is read from LANESTREAM_<NAME>."""

    model_config = SettingsConfigDict(env_prefix=_PREFIX, env_ignore_empty=True, frozen=True, extra="forbid")

    host: str = Field(default="127.0.0.1", min_length=1, description="Address to listen on.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    model: Path | None = Field(default=None, description="ONNX file of the network; the shipped one where absent.")
    regressor: Path | None = Field(
        default=None, description="ONNX file of the second network, or `none`; the shipped one where absent."
    )
    provider: Provider = Field(default="auto", description="Where the networks run.")
    inference_threads: int | None = Field(
        default=None, ge=1, le=256, description="Threads of one network's run on the CPU; one a processor where absent."
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
        default=10.0, gt=0.0, description="The first message of a stream comes within this time."
    )
    idle_s: float = Field(default=60.0, gt=0.0, description="A stream from which nothing comes for so long is closed.")
    session_s: float = Field(default=86_400.0, gt=0.0, description="A session's longest life, over all its sockets.")
    resume_s: float = Field(default=60.0, ge=1.0, description="A session can be resumed so long after its last socket.")
    drain_s: float = Field(default=10.0, ge=0.0, description="Before a stop, frames are answered for so long at most.")
    redis_url: SecretStr | None = Field(
        default=None,
        description="Redis that keeps sessions for all replicas, redis://host:6379/0; in memory if absent.",
    )
    threads: Annotated[int, Field(ge=1, le=256, description="Threads that decode, propose and track.")] = Field(
        default_factory=processors
    )
    opencv_threads: int = Field(default=1, ge=1, le=256, description="Threads that OpenCV takes for one image.")

    @property
    def runtime_options(self) -> RuntimeOptions:
        """How the networks run."""
        return RuntimeOptions(self.inference_threads, self.tensorrt_cache)

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
    """Settings from the environment, where not `given` (None counts as not given).

    Raises SettingsError with one line that names the variable or option.
    """
    chosen = {name: value for name, value in given.items() if value is not None}
    try:
        return Settings(**chosen)  # type: ignore[arg-type]
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        name = str(problem["loc"][0])
        label = f"--{name.replace('_', '-')}" if name in chosen else _PREFIX + name.upper()
        raise SettingsError(f"{label} = {problem['input']!r}: {_sentence(problem['msg'])}") from None


def _sentence(message: str) -> str:
    return message[:1].lower() + message[1:]
