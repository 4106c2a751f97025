"""The requests that clients send and the responses that they parse, without the transport.

The blocking and the async client share this module.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
from pydantic import ValidationError

from lanestream.errors import NoDetectorError, ProtocolError
from lanestream.protocol import (
    BoundaryKind,
    CameraModel,
    DepartureOptions,
    DetectorName,
    Mode,
    StartMessage,
    parse_client_message,
)
from lanestream_client import image_files
from lanestream_client.endpoint import Endpoint, refusal_error
from lanestream_client.frames import DetectedLanes, SourceFrame, as_source_frame

if TYPE_CHECKING:
    from lanestream_client.pixels import BgrImage

Query = dict[str, float | str | list[str]]


@dataclass(frozen=True)
class ServiceInfo:
    """The name of a model, and the execution provider that runs it."""

    model: str
    provider: str


def read_image(image: bytes | str | Path | BgrImage) -> SourceFrame:
    """Returns the frame of an image file, its content or its path, or of BGR pixels (H, W, 3) uint8.

    Raises SourceError if the file can't be read, and ImageError if pixels have another type or shape.
    """
    return as_source_frame(image_files.read_image_file(Path(image)) if isinstance(image, str | Path) else image)


def detect_query(
    horizon: float | None,
    detector: DetectorName | None,
    camera: CameraModel | None,
    kinds: Sequence[BoundaryKind] | None,
) -> Query:
    """Returns the query parameters of `/v1/detect`. Raises ProtocolError if `kinds` is empty."""
    if kinds is not None and not kinds:
        raise ProtocolError("no kind of boundaries is to be reported", "give marking, road_edge or both")
    given: dict[str, float | str | list[str] | None] = {
        "horizon": horizon,
        "detector": detector,
        "kinds": None if kinds is None else list(kinds),
    }
    if camera is not None:
        given |= _camera_parameters(camera)
    return {name: value for name, value in given.items() if value is not None}


def _camera_parameters(camera: CameraModel) -> dict[str, float | str | list[str] | None]:
    """Returns the query parameters of a camera: two numbers, which older services know too, or all as JSON."""
    if camera.model_dump(exclude_defaults=True).keys() == {"height", "field_of_view"}:
        return {"camera_height": camera.height, "field_of_view": camera.field_of_view}
    return {"camera": camera.model_dump_json(exclude_defaults=True)}


def start_message(
    mode: Mode,
    horizon: float | None,
    detector: DetectorName | None,
    camera: CameraModel | None,
    departure: DepartureOptions | None,
    kinds: Sequence[BoundaryKind] | None,
    session: str | None,
) -> StartMessage:
    """Returns the message that opens a stream. Raises ProtocolError if an argument is not valid."""
    fields = {
        "type": "start",
        "mode": mode,
        "horizon": horizon,
        "detector": detector,
        "camera": None if camera is None else camera.model_dump(exclude_defaults=True),
        "departure": None if departure is None else departure.model_dump(),
        "kinds": None if kinds is None else list(kinds),
        "session": session,
    }
    try:
        message = parse_client_message(json.dumps(fields))
    except ProtocolError as error:
        # The hint describes raw messages, which a caller of this client does not write.
        raise ProtocolError(error.message) from None
    assert isinstance(message, StartMessage)  # noqa: S101 - guaranteed by its type field
    return message


def check_response(response: httpx.Response, endpoint: Endpoint) -> httpx.Response:
    """Returns the response if it is successful. Raises the error that the service sent otherwise."""
    if response.is_success:
        return response
    raise refusal_error(response.status_code, response.content, endpoint)


def parse_lanes(response: httpx.Response) -> DetectedLanes:
    """Returns the lanes in a response of `/v1/detect`. Raises ProtocolError if it is not valid."""
    try:
        return DetectedLanes.model_validate_json(response.content)
    except ValidationError:
        raise ProtocolError("the service sent a response that is not a `lanes` message") from None


def parse_service_info(response: httpx.Response, detector: DetectorName | None) -> ServiceInfo:
    """Returns what a response of `/v1/models` says about a detector, or about the default detector if None.

    The default detector is the first in the list. Raises NoDetectorError if the service has not loaded the detector,
    and ProtocolError if the response is not valid.
    """
    try:
        models = response.json()["models"]
        infos = {model["detector"]: ServiceInfo(str(model["name"]), str(model["provider"])) for model in models}
        default = models[0]["detector"]
    except (ValueError, TypeError, LookupError):
        raise ProtocolError("the service sent a response that is not a list of models") from None
    if detector not in (None, *infos):
        raise NoDetectorError(f"the service has no detector {detector}", f"ask for {', '.join(infos)}")
    return infos[detector or default]
