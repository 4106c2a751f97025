"""Single requests: lanes of one image, what the service is, and whether it can be used."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self

import cv2
from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import BaseModel

from lanestream.api.content_negotiation import preferred
from lanestream.api.metrics import MEDIA_TYPE
from lanestream.api.problems import Problem
from lanestream.api.service import Service
from lanestream.asyncapi import document
from lanestream.errors import NotAcceptableError, one_line
from lanestream.images.decoding import decode
from lanestream.messages import lanes_message
from lanestream.protocol import CameraHeight, CameraModel, DetectorName, FieldOfView, LanesMessage, camera_of, schemas
from lanestream.streaming.caller import Caller
from lanestream.workers.frame_worker import EncodedFrame

if TYPE_CHECKING:
    from lanestream.api.service import Draw
    from lanestream.messages import ProcessedFrame
    from lanestream.streaming.session_registry import OpenSession
    from lanestream.workers.capabilities import Offer

# For everybody: whether the service lives, and what its own repository tells as well.
open_router = APIRouter()
# For those whom the authenticator lets in.
router = APIRouter()
# For those whom the setting `metrics_access` names.
metrics_router = APIRouter()

_JSON: Final = "application/json"
_PICTURES: Final = {"image/jpeg": ".jpg", "image/png": ".png"}
_BINARY: Final = {"schema": {"type": "string", "format": "binary"}}
_FORM: Final = {"schema": {"type": "object", "properties": {"file": _BINARY["schema"]}, "required": ["file"]}}


class NetworkEntry(BaseModel):
    """A loaded network: its name and version, the detector that it answers, and what runs it."""

    name: str
    detector: str
    provider: str

    @classmethod
    def of(cls, offer: Offer, **more: Any) -> Self:
        """The entry of an offer's network, with the fields `more`."""
        return cls(name=offer.network.name, detector=offer.detector, provider=offer.network.provider, **more)


class ModelEntry(NetworkEntry):
    """A loaded network, the SHA-256 of its file, and what that says of itself."""

    sha256: str
    metadata: dict[str, Any]

    @classmethod
    def about(cls, offer: Offer) -> Self:
        """The entry of an offer's network."""
        return cls.of(offer, sha256=offer.network.sha256, metadata=dict(offer.network.metadata))


class ModelList(BaseModel):
    """The networks of the service; the first is the default."""

    models: list[ModelEntry]


class Readiness(BaseModel):
    """That the service can be used, and with what; `provider` runs the default detector's network, the first one."""

    status: Literal["ready"]
    provider: str
    networks: list[NetworkEntry]


_PROBLEMS: Final[dict[int | str, dict[str, Any]]] = {
    406: {"model": Problem, "description": "No answer in the form that was asked for"},
    408: {"model": Problem, "description": "A body that took too long to come"},
    413: {"model": Problem, "description": "More bytes or pixels than are accepted"},
    415: {"model": Problem, "description": "Not an image, or a corrupt one"},
    422: {"model": Problem, "description": "A malformed request, or a detector that is not loaded"},
    503: {"model": Problem, "description": "Not ready yet, or at the session limit"},
}
REFUSALS: Final[dict[int | str, dict[str, Any]]] = {
    401: {"model": Problem, "description": "No API key, or a wrong one"},
    403: {"model": Problem, "description": "A web page of an origin that may not"},
}


async def admitted(request: Request) -> Caller:
    """Who asks. Raises UnauthorizedError or ForbiddenError where they may not."""
    return _service(request).authenticator.admit(request)


def _camera(
    camera_height: Annotated[
        CameraHeight | None, Query(description="Metres up to the camera; lanes in metres.")
    ] = None,
    field_of_view: Annotated[FieldOfView | None, Query(description="Its horizontal field of view in degrees.")] = None,
) -> CameraModel | None:
    """The camera of a request. Raises ProtocolError for half of one."""
    return camera_of(camera_height, field_of_view)


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
    caller: Annotated[Caller, Depends(admitted)],
    camera: Annotated[CameraModel | None, Depends(_camera)],
    horizon: Annotated[
        float | None, Query(gt=0.0, lt=1.0, description="Row of the horizon as a share of the image height.")
    ] = None,
    detector: Annotated[
        DetectorName | None, Query(description="What finds the lanes; the service's default where absent.")
    ] = None,
) -> Response:
    """The lanes of one image, sent as the body or as the file of a form; as JSON, or drawn on it by `Accept`."""
    service = _service(request)
    service.check_open()
    runner = service.runner
    form = _answer_form(request, service.draw)
    # What is refused anyway is refused before its body is read; what is read slowly holds no session meanwhile.
    runner.offers.chosen(detector)
    service.sessions.check_limits(caller)
    data = await service.bodies.image_file(request)
    with service.sessions.opened(runner, caller, horizon, detector) as opened:
        frame = await _processed(service, opened, EncodedFrame(data, 0.0, time.monotonic()))
    message = lanes_message(frame, seq=0, timestamp=0.0, camera=camera)
    if form == _JSON:
        return Response(message.model_dump_json(), media_type=_JSON)
    picture = await runner.work(_picture, service, data, message, form)
    return Response(picture, media_type=form)


@router.get("/v1/models", responses={503: _PROBLEMS[503]})
async def models(request: Request) -> ModelList:
    """The networks that are loaded, the default detector's first, and what really runs them."""
    return ModelList(models=[ModelEntry.about(offer) for offer in _service(request).runner.offers.all])


@open_router.get("/v1/schema")
async def schema() -> dict[str, dict[str, Any]]:
    """JSON Schemas of the messages of `/v1/stream`: what a client sends, and what the service sends."""
    return schemas()


@open_router.get("/v1/asyncapi.json")
async def asyncapi() -> dict[str, Any]:
    """The contract of `/v1/stream` as an AsyncAPI 3.0 document, with the same schemas."""
    return document()


@open_router.get("/healthz")
async def healthz() -> dict[str, str]:
    """Answers while the process lives."""
    return {"status": "alive"}


@open_router.get("/readyz", responses={503: _PROBLEMS[503]})
async def readyz(request: Request) -> Readiness:
    """Answers once the networks are loaded and warm, until the service is about to stop."""
    _service(request).check_open()
    networks = [NetworkEntry.of(offer) for offer in _service(request).runner.offers.all]
    return Readiness(status="ready", provider=networks[0].provider, networks=networks)


@metrics_router.get("/metrics", response_class=Response, responses={200: {"content": {MEDIA_TYPE: {}}}})
async def exposition(request: Request) -> Response:
    """Counters and histograms in Prometheus' text format."""
    metrics = _service(request).metrics
    metrics.tasks(len(asyncio.all_tasks()))
    return Response(metrics.exposition(), headers={"content-type": MEDIA_TYPE})


async def _processed(service: Service, opened: OpenSession, image: EncodedFrame) -> ProcessedFrame:
    """The lanes of an image, counted whether they are found or not."""
    service.metrics.frame_received()
    try:
        async with service.runner.turn():
            frame = await service.runner.run(opened.camera, image)
    except BaseException as error:
        service.metrics.frame_failed(error)
        raise
    service.metrics.frame_processed(frame.result.timing_ms, time.monotonic() - image.arrived)
    return frame


def _service(request: Request) -> Service:
    service: Service = request.app.state.service
    return service


def _answer_form(request: Request, draw: Draw | None) -> str:
    offered = [_JSON, *_PICTURES] if draw is not None else [_JSON]
    form = preferred(request.headers.get("accept", "*/*"), offered)
    if form is None:
        raise NotAcceptableError(
            f"no answer as {one_line(request.headers['accept'], 80)!r}", f"{', '.join(offered)} can be had"
        )
    return form


def _picture(service: Service, data: bytes, message: LanesMessage, form: str) -> bytes:
    assert service.draw is not None  # noqa: S101 - else there would be no such form
    image = decode(data, service.settings.image_limits)
    _, encoded = cv2.imencode(_PICTURES[form], service.draw(image, message))
    return encoded.tobytes()
