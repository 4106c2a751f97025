"""Requests and answers of `/v1/detect` without their transport, shared by the blocking and the awaiting client."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import responses
from pathlib import Path
from typing import Any

import httpx
from pydantic import ValidationError

from lanestream.errors import (
    ConnectionFailedError,
    LanestreamError,
    NoDetectorError,
    ProtocolError,
    SourceError,
    error_from_code,
)
from lanestream.protocol import CameraModel, DetectorName, LanesMessage, Mode, StartMessage, parse_client_message
from lanestream_client.service import ServiceInfo


def image_bytes(image: bytes | str | Path) -> bytes:
    """The image file itself, or the one at a path. Raises SourceError where it can't be read."""
    if isinstance(image, bytes):
        return image
    try:
        return Path(image).read_bytes()
    except OSError as error:
        raise SourceError(f"can't read {image}: {(error.strerror or str(error)).lower()}") from None


def parameters(
    horizon: float | None, detector: DetectorName | None, camera: CameraModel | None
) -> dict[str, float | str]:
    """The query of a request."""
    given: dict[str, float | str | None] = {"horizon": horizon, "detector": detector}
    if camera is not None:
        given |= {"camera_height": camera.height, "field_of_view": camera.field_of_view}
    return {name: value for name, value in given.items() if value is not None}


def lanes_of(response: httpx.Response) -> LanesMessage:
    """The lanes in an answer. Raises the error that the service told."""
    try:
        return LanesMessage.model_validate_json(checked(response).content)
    except ValidationError:
        raise ProtocolError("the service answered with something unknown") from None


def info_of(response: httpx.Response, detector: DetectorName | None) -> ServiceInfo:
    """What runs, in an answer of `/v1/models`, for a detector; for the default one, which is the first, where None.

    Raises NoDetectorError where the service has not loaded it, and the error that the service told.
    """
    try:
        models = checked(response).json()["models"]
        infos = {model["detector"]: ServiceInfo(str(model["name"]), str(model["provider"])) for model in models}
        default = models[0]["detector"]
    except (ValueError, TypeError, LookupError):
        raise ProtocolError("the service answered with something unknown") from None
    if detector not in (None, *infos):
        raise NoDetectorError(f"the service has no detector {detector}", f"ask for {', '.join(infos)}")
    return infos[detector or default]


def checked(response: httpx.Response) -> httpx.Response:
    """The answer, where it is a good one. Raises the error that the service told."""
    if response.is_success:
        return response
    raise refused(response.status_code, response.content, str(response.url.copy_with(userinfo=b"")))


def refused(status: int, body: bytes | bytearray, place: str) -> LanestreamError:
    """The error in an answer that is no good one: as the service told it, or else what its status says."""
    try:
        problem: dict[str, Any] = json.loads(body)
        return error_from_code(str(problem["code"]), str(problem["message"]), str(problem["hint"]))
    except (ValueError, TypeError, KeyError):
        answer = f"{status} {responses.get(status, '')}".rstrip()
        return ConnectionFailedError(f"{place} answered {answer}", "is this a Lanestream service?")


@contextmanager
def reaching(place: str) -> Iterator[None]:
    """Admission the transport's failures into ConnectionFailedError."""
    try:
        yield
    except httpx.HTTPError as error:
        raise unreachable(place, error) from None


def unreachable(place: str, error: Exception) -> ConnectionFailedError:
    """The error for a service that can't be reached."""
    timed_out = isinstance(error, TimeoutError | httpx.TimeoutException)
    reason = "no answer in time" if timed_out else re.sub(r"^\[Errno -?\d+\] ", "", str(error))
    reason = reason or type(error).__name__
    return ConnectionFailedError(f"can't reach the service at {place}: {reason}", "start one with `lanestream serve`")


def start(
    mode: Mode, horizon: float | None, detector: DetectorName | None, camera: CameraModel | None, session: str | None
) -> StartMessage:
    """What opens a stream. Raises ProtocolError where something is asked for that is none."""
    asked = {
        "type": "start",
        "mode": mode,
        "horizon": horizon,
        "detector": detector,
        "camera": None if camera is None else camera.model_dump(),
        "session": session,
    }
    try:
        message = parse_client_message(json.dumps(asked))
    except ProtocolError as error:
        raise ProtocolError(error.message) from None  # its hint is about messages, which a caller here does not write
    assert isinstance(message, StartMessage)  # noqa: S101 - its type says so
    return message
