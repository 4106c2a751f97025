"""Single requests: the lanes of one image, the loaded models, readiness, metrics and schemas."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from http import HTTPStatus
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self

import cv2
from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response
from pydantic import BaseModel

from lanestream.api.metrics import MEDIA_TYPE
from lanestream.api.problems import Problem
from lanestream.api.request_id import add_trace, current_request_id
from lanestream.api.service import Service
from lanestream.errors import NotAcceptableError, ProtocolError, one_line
from lanestream.images.decoding import decode
from lanestream.messages import lanes_message
from lanestream.protocol import (
    BoundaryKind,
    CameraHeight,
    CameraModel,
    DetectorName,
    FieldOfView,
    Horizon,
    LanesMessage,
    StartMessage,
    parse_camera,
)
from lanestream.streaming.session_registry import Caller
from lanestream.workers.frame_worker import EncodedFrame

if TYPE_CHECKING:
    from fastapi.dependencies.models import Dependant
    from starlette.types import Receive, Scope, Send

    from lanestream.api.byte_budget import Charge
    from lanestream.messages import ProcessedFrame
    from lanestream.streaming.session_registry import OpenSession
    from lanestream.workers.capabilities import DetectorInfo


def known_fields(request: Request) -> None:
    """Raises ProtocolError if the URL has a query field that its route does not know: it is probably misspelled."""
    known = list(_query_fields(request.scope["route"].dependant))
    for name in request.query_params:
        if name not in known:
            accepted = f"{', '.join(known)} are accepted" if known else "none is accepted here"
            raise ProtocolError(f"unknown query field {one_line(repr(name), 80)}", accepted)


def _query_fields(dependant: Dependant) -> Iterator[str]:
    """Yields the names of the query fields of a route and of what it depends on."""
    yield from (field.alias for field in dependant.query_params)
    for dependency in dependant.dependencies:
        yield from _query_fields(dependency)


# Open to everyone: health checks, and documents that are public anyway.
public_router = APIRouter()
# Behind the authenticator.
router = APIRouter(dependencies=[Depends(known_fields)])
# For the callers that the setting `metrics_access` allows.
metrics_router = APIRouter()

_JSON: Final = "application/json"
_PART_BYTES: Final = 1 << 16
_MOST_CAMERA_CHARACTERS: Final = 2048
_MOST_ORIGIN_CHARACTERS: Final = 512
_PICTURES: Final = {"image/jpeg": ".jpg", "image/png": ".png"}
_BINARY: Final = {"schema": {"type": "string", "format": "binary"}}
_FORM: Final = {"schema": {"type": "object", "properties": {"file": _BINARY["schema"]}, "required": ["file"]}}


class NetworkEntry(BaseModel):
    """A loaded network: its name and version, the detector that uses it, and the provider that runs it."""

    name: str
    detector: str
    provider: str

    @classmethod
    def from_info(cls, info: DetectorInfo, **fields: Any) -> Self:
        """Returns the entry of a detector's network, with these further fields."""
        return cls(name=info.model.name, detector=info.detector, provider=info.model.provider, **fields)


class ModelEntry(NetworkEntry):
    """A loaded network with the SHA-256 of its file and the file's metadata."""

    sha256: str
    metadata: dict[str, Any]


class ModelList(BaseModel):
    """The loaded networks. The first one belongs to the default detector."""

    models: list[ModelEntry]


class AccessToken(BaseModel):
    """An access token, which is used like an API key and expires after `expires_s` seconds."""

    token: str
    expires_s: float


class Readiness(BaseModel):
    """The loaded networks of a service that is ready. `provider` runs the default detector's network, the first one.

    Without its session store the service works, but sessions can't be resumed on other replicas.
    """

    status: Literal["ready"]
    provider: str
    networks: list[NetworkEntry]
    store: str
    store_reachable: bool


_PROBLEMS: Final[dict[int | str, dict[str, Any]]] = {
    406: {"model": Problem, "description": "No accepted media type is available"},
    408: {"model": Problem, "description": "The body took too long to arrive"},
    413: {"model": Problem, "description": "The image has too many bytes or pixels"},
    414: {"model": Problem, "description": "The URL is too long"},
    415: {"model": Problem, "description": "The body is not an image, or a corrupt one"},
    422: {"model": Problem, "description": "The request is malformed, or the detector is not loaded"},
    503: {"model": Problem, "description": "The service is not ready, or at its session limit"},
}
AUTH_PROBLEMS: Final[dict[int | str, dict[str, Any]]] = {
    401: {"model": Problem, "description": "The API key is missing or unknown"},
    403: {"model": Problem, "description": "The origin of the web page is not allowed"},
}


_PROBLEMS_OF_STREAM: Final[dict[int | str, dict[str, Any]]] = {
    403: AUTH_PROBLEMS[403],
    422: _PROBLEMS[422],
    503: _PROBLEMS[503],
}


class PictureResponse(Response):
    """A picture, which is sent in parts as the peer reads it, and charged to the caller until it is sent.

    Raises BusyError if it does not fit into what the caller may keep.
    """

    def __init__(self, picture: bytes, media_type: str, charge: Charge) -> None:
        super().__init__(picture, media_type=media_type)
        self._charge = charge
        charge.set(len(picture))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:  # noqa: ARG002 - the ASGI interface
        """Sends the response."""
        try:
            await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
            picture = memoryview(self.body)
            for start in range(0, len(picture), _PART_BYTES):
                part = bytes(picture[start : start + _PART_BYTES])
                more = start + _PART_BYTES < len(picture)
                await send({"type": "http.response.body", "body": part, "more_body": more})
        finally:
            self._charge.set(0)


async def authenticated(request: Request) -> Caller:
    """Returns the caller. Raises UnauthorizedError or ForbiddenError."""
    return _service(request).authenticator.authenticate(request)


def _camera(
    camera_height: Annotated[
        CameraHeight | None, Query(description="Height of the camera in meters; adds coordinates in meters.")
    ] = None,
    field_of_view: Annotated[FieldOfView | None, Query(description="Horizontal field of view in degrees.")] = None,
    camera: Annotated[
        str | None,
        Query(max_length=_MOST_CAMERA_CHARACTERS, description="The whole camera as JSON, instead of the two above."),
    ] = None,
) -> CameraModel | None:
    """Returns the camera of a request. Raises ProtocolError if it is not complete or not valid."""
    return parse_camera(camera_height, field_of_view, camera)


@router.post(
    "/v1/detect",
    response_model=LanesMessage,
    responses={200: {"content": dict.fromkeys(_PICTURES, _BINARY)}, **_PROBLEMS},
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "image/jpeg": _BINARY,
                "image/png": _BINARY,
                "image/webp": _BINARY,
                "multipart/form-data": _FORM,
            },
        }
    },
)
async def detect(
    request: Request,
    caller: Annotated[Caller, Depends(authenticated)],
    camera: Annotated[CameraModel | None, Depends(_camera)],
    horizon: Annotated[
        Horizon | None,
        Query(description="Row of the horizon as a fraction of the image height, negative above the image."),
    ] = None,
    detector: Annotated[
        DetectorName | None, Query(description="The detector that finds the lanes; the service's default if missing.")
    ] = None,
    kinds: Annotated[
        list[BoundaryKind] | None,
        Query(description="A kind of boundaries to report, repeated for several; the service's setting if missing."),
    ] = None,
) -> Response:
    """Returns the lanes of one image, sent as the body or as a form file: as JSON, or drawn on it, by `Accept`."""
    service = _service(request)
    service.check_ready()
    pool = service.pool
    media_type = _response_media_type(request, service)
    # Requests that fail anyway are refused before their body is read, and a slow body does not occupy a session.
    pool.capabilities.select(detector)
    chosen = None if kinds is None else tuple(kinds)
    start = StartMessage(horizon=horizon, detector=detector, camera=camera, kinds=chosen)
    options = service.session_options(start)
    service.sessions.check_limits(caller)
    with service.answering(request, caller):
        async with service.bodies.image(request, caller.quota) as data:
            with service.sessions.temporary(pool, caller, options) as session:
                frame = await _process(service, session, caller, data, request)
                message = lanes_message(frame, seq=0, timestamp=0.0)
                if media_type == _JSON:
                    return Response(message.model_dump_json(), media_type=_JSON)
                async with pool.admit(caller.quota) as slot:
                    picture, cpu_s = await pool.in_thread(_draw_picture, service, data, message, media_type)
                    slot.charge(cpu_s)
    return PictureResponse(picture, media_type, service.budget.charge(caller.quota))


@router.get("/v1/models", responses={503: _PROBLEMS[503]})
async def models(request: Request) -> ModelList:
    """Returns the loaded networks and the providers that run them, the default detector's first."""
    entries = [
        ModelEntry.from_info(info, sha256=info.model.sha256, metadata=dict(info.model.metadata))
        for info in _service(request).pool.capabilities.detectors
    ]
    return ModelList(models=entries)


@router.post("/v1/tokens", responses={422: _PROBLEMS[422]})
async def tokens(request: Request) -> AccessToken:
    """Returns an access token in exchange for the request's API key, for a web page to use instead of the key."""
    service = _service(request)
    token = service.authenticator.issue_token(request)
    return AccessToken(token=token, expires_s=service.settings.token_s)


@router.get("/v1/stream", status_code=426, response_model=Problem, responses=_PROBLEMS_OF_STREAM)
async def stream_access(
    request: Request,
    origin: Annotated[
        str | None,
        Query(
            max_length=_MOST_ORIGIN_CHARACTERS,
            description="The origin of the page that asks; browsers send it only with requests to other origins.",
        ),
    ] = None,
) -> Response:
    """Responds as to a WebSocket handshake that is refused, and with 426 if the handshake would be accepted.

    Browsers do not let a page see why a handshake failed, so it can ask here.
    """
    service = _service(request)
    service.authenticator.check_origin(request, origin)
    service.check_ready()
    raise HTTPException(
        HTTPStatus.UPGRADE_REQUIRED,
        "this is a WebSocket, and a handshake would be accepted: connect with ws:// or wss://",
        {"upgrade": "websocket", "connection": "upgrade"},
    )


@public_router.get("/v1/schema", response_model=dict[str, dict[str, Any]])
async def schema(request: Request) -> Response:
    """Returns the JSON Schemas of the messages of `/v1/stream`, by the side that sends them."""
    return Response(_service(request).schemas, media_type=_JSON)


@public_router.get("/v1/asyncapi.json", response_model=dict[str, Any])
async def asyncapi(request: Request) -> Response:
    """Returns the contract of `/v1/stream` as an AsyncAPI 3.0 document."""
    return Response(_service(request).asyncapi, media_type=_JSON)


@public_router.get("/healthz", responses={503: _PROBLEMS[503]})
async def healthz(request: Request) -> dict[str, str]:
    """Responds with 200 while the process is alive and can replace its workers; with 503 it should be restarted."""
    _service(request).check_alive()
    return {"status": "alive"}


@public_router.get("/readyz", responses={503: _PROBLEMS[503]})
async def readyz(request: Request) -> Readiness:
    """Responds with 200 once the networks are loaded and warm, until the service is about to stop."""
    service = _service(request)
    service.check_ready()
    networks = [NetworkEntry.from_info(info) for info in service.pool.capabilities.detectors]
    return Readiness(
        status="ready",
        provider=networks[0].provider,
        networks=networks,
        store=service.store_name,
        store_reachable=service.sessions.store_reachable,
    )


@metrics_router.get("/metrics", response_class=Response, responses={200: {"content": {MEDIA_TYPE: {}}}})
async def exposition(request: Request) -> Response:
    """Returns the metrics in Prometheus' text format."""
    service = _service(request)
    service.sample_metrics()
    return Response(service.metrics.exposition(), headers={"content-type": MEDIA_TYPE})


def preferred_media_type(accept: str, available: Sequence[str]) -> str | None:
    """Returns the available media type with the highest weight in an Accept header, the first of equals.

    None if the header accepts none of them (RFC 9110, section 12.5.1).
    """
    weights = dict(_parse_media_range(part) for part in accept.split(",") if part.strip())

    def weight(media_type: str) -> float:
        """Returns the weight of the most specific range that matches."""
        for media_range in (media_type, f"{media_type.partition('/')[0]}/*", "*/*"):
            if media_range in weights:
                return weights[media_range]
        return 0.0

    best = max(available, key=weight)
    return best if weight(best) > 0.0 else None


def _parse_media_range(part: str) -> tuple[str, float]:
    """Returns a media range and its weight; 1 without a `q` parameter, 0 for a malformed one."""
    media_range, *parameters = (piece.strip().lower() for piece in part.split(";"))
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip() == "q":
            try:
                return media_range, float(value)
            except ValueError:
                return media_range, 0.0
    return media_range, 1.0


def _response_media_type(request: Request, service: Service) -> str:
    """Returns the media type of the response. Raises NotAcceptableError if the client accepts none."""
    available = [_JSON, *_PICTURES] if service.draw is not None else [_JSON]
    media_type = preferred_media_type(request.headers.get("accept", "*/*"), available)
    if media_type is None:
        accept = one_line(request.headers["accept"], 80)
        raise NotAcceptableError(
            f"no response is available as {accept!r}", f"available media types: {', '.join(available)}"
        )
    return media_type


async def _process(
    service: Service, session: OpenSession, caller: Caller, data: bytes, request: Request
) -> ProcessedFrame:
    """Returns the lanes of an image. Counts and traces the frame, processed or failed."""
    attributes = {"caller": caller.identity, "request_id": current_request_id()}
    service.metrics.frame_received()
    arrived = time.monotonic()
    image = EncodedFrame(data, 0.0, arrived, arrived + service.settings.body_s)
    try:
        async with service.pool.admit(caller.quota) as slot:
            frame = await service.pool.run(session.handle, image, slot)
    except BaseException as error:
        service.metrics.frame_failed(error)
        if service.tracer is not None:
            add_trace(service.tracer.record(arrived, attributes, error=error, headers=request.headers))
        raise
    if service.tracer is not None:
        add_trace(service.tracer.record(arrived, attributes, frame.result.timing_ms, headers=request.headers))
    service.metrics.frame_processed(frame.result.timing_ms, time.monotonic() - image.arrived)
    return frame


def _draw_picture(service: Service, data: bytes, message: LanesMessage, media_type: str) -> tuple[bytes, float]:
    """Returns the image file of a picture, and the processor time that it took in seconds."""
    assert service.draw is not None  # noqa: S101 - pictures are available only with it
    started = time.thread_time()
    image = decode(data, service.settings.image_limits)
    _, encoded = cv2.imencode(_PICTURES[media_type], service.draw(image, message))
    return encoded.tobytes(), time.thread_time() - started


def _service(request: Request) -> Service:
    service: Service = request.app.state.service
    return service
