"""The contract of `/v1/stream` as an AsyncAPI 3.0 document, made from the very models that the service speaks with.

It takes the service's view: what a client sends is received here.
"""

from __future__ import annotations

from typing import Any, Final

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaMode, JsonSchemaValue, models_json_schema
from pydantic_core import core_schema

from lanestream import __version__
from lanestream.errors import told_errors
from lanestream.protocol import (
    KEY_SUBPROTOCOL,
    SUBPROTOCOL,
    DrainingMessage,
    EndMessage,
    ErrorMessage,
    FrameMessage,
    LanesMessage,
    ReadyMessage,
    StartMessage,
    SummaryMessage,
)

_SCHEMAS: Final = "#/components/schemas/"
_STREAM: Final = "#/channels/stream"
_CLIENT: Final[tuple[type[BaseModel], ...]] = (StartMessage, FrameMessage, EndMessage)
_SERVER: Final[tuple[type[BaseModel], ...]] = (
    ReadyMessage,
    LanesMessage,
    ErrorMessage,
    DrainingMessage,
    SummaryMessage,
)
_EXAMPLES: Final[dict[str, dict[str, Any]]] = {
    "start": {"type": "start", "mode": "all", "camera": {"height": 1.4, "field_of_view": 62.0}},
    "frame": {"type": "frame", "seq": 7, "timestamp": 0.28},
    "end": {"type": "end"},
    "error": {
        "type": "error",
        "code": "bad_image",
        "message": "the JPEG image is cut short: its end is missing",
        "hint": "send the whole file",
        "seq": 7,
        "fatal": False,
    },
    "draining": {"type": "draining", "resume_token": "4Hs0...", "deadline_s": 10.0},
    "summary": {"type": "summary", "frames": 250, "answered": 248, "failed": 1, "dropped": 1, "duration_s": 10.02},
}
# Closes without an error; the others follow one, whose code tells which.
_CLOSES: Final[dict[int, str]] = {
    1000: "after `summary`",
    1009: "a message of more than twice the bytes that an image may have",
    1012: "after `draining`, when every frame that came before was answered",
}


class _Draft7(GenerateJsonSchema):
    """Schemas in the dialect that AsyncAPI asks for."""

    def tuple_schema(self, schema: core_schema.TupleSchema) -> JsonSchemaValue:
        """A tuple's items in one list, as it was written before 2020."""
        written = super().tuple_schema(schema)
        if "prefixItems" in written:
            written["items"] = written.pop("prefixItems")
        return written


def document() -> dict[str, Any]:
    """The AsyncAPI document, of plain values."""
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "Lanestream",
            "version": __version__,
            "description": "Camera frames in, tracked lane lines out. docs/protocol.md tells the protocol in prose.",
            "license": {"name": "Apache-2.0", "url": "https://www.apache.org/licenses/LICENSE-2.0"},
        },
        "defaultContentType": "application/json",
        "servers": {"local": _server()},
        "channels": {"stream": _channel()},
        "operations": _operations(),
        "components": {
            "messages": {**_messages(), "image": _image()},
            "schemas": _schemas(),
            "securitySchemes": _security(),
        },
    }


def _server() -> dict[str, Any]:
    return {
        "host": "127.0.0.1:8000",
        "protocol": "ws",
        "description": "What `lanestream serve` listens on. With API keys one of the two ways to show one is needed.",
        "security": [{"$ref": f"#/components/securitySchemes/{name}"} for name in _security()],
    }


def _security() -> dict[str, Any]:
    return {
        "header": {"type": "http", "scheme": "bearer", "description": "For programs: `Authorization: Bearer KEY`."},
        "subprotocol": {
            "type": "httpApiKey",
            "in": "header",
            "name": "Sec-WebSocket-Protocol",
            "description": f"For browsers: the subprotocol `{KEY_SUBPROTOCOL}KEY`, offered beside `{SUBPROTOCOL}`.",
        },
    }


def _channel() -> dict[str, Any]:
    headers = {
        "Sec-WebSocket-Protocol": {"type": "string", "description": f"`{SUBPROTOCOL}`, the version spoken here."},
        "Authorization": {"type": "string", "description": "`Bearer KEY`, where the service asks for one."},
        "Origin": {"type": "string", "description": "The page's, from a browser; it has to be an allowed one."},
    }
    return {
        "address": "/v1/stream",
        "title": "A stream of frames",
        "description": "One camera's frames in, the lanes of each out. Only `image` is needed; it is a binary message,"
        " all others are text. Without compression: images are compressed already.",
        "servers": [{"$ref": "#/servers/local"}],
        "messages": {name: {"$ref": f"#/components/messages/{name}"} for name in (*_messages(), "image")},
        "bindings": {"ws": {"method": "GET", "headers": {"type": "object", "properties": headers}}},
        "x-subprotocol": SUBPROTOCOL,
        "x-close-codes": {str(code): meaning for code, meaning in sorted(_CLOSES.items())},
    }


def _operations() -> dict[str, Any]:
    return {
        "open": _receives("Opens the stream; without it the first image does.", ["start"], ["ready", "error"]),
        "find": _receives(
            "One image, with its number and its time right before it.", ["frame", "image"], ["lanes", "error"]
        ),
        "end": _receives("No more images come.", ["end"], ["summary"]),
        "tell": {
            "action": "send",
            "channel": {"$ref": _STREAM},
            "summary": "What comes unasked: errors that end the stream, and that the service is about to stop.",
            "messages": _of_channel(["error", "draining"]),
        },
    }


def _receives(summary: str, messages: list[str], replies: list[str]) -> dict[str, Any]:
    return {
        "action": "receive",
        "channel": {"$ref": _STREAM},
        "summary": summary,
        "messages": _of_channel(messages),
        "reply": {"channel": {"$ref": _STREAM}, "messages": _of_channel(replies)},
    }


def _of_channel(names: list[str]) -> list[dict[str, str]]:
    return [{"$ref": f"{_STREAM}/messages/{name}"} for name in names]


def _messages() -> dict[str, Any]:
    """The text messages by their type."""
    told: dict[str, Any] = {}
    for model in (*_CLIENT, *_SERVER):
        name = model.model_fields["type"].default
        told[name] = {
            "name": name,
            "summary": " ".join((model.__doc__ or "").split("\n\n")[0].split()),
            "payload": {"$ref": f"{_SCHEMAS}{model.__name__}"},
        }
        if name in _EXAMPLES:
            told[name]["examples"] = [{"payload": _EXAMPLES[name]}]
    told["error"]["x-codes"] = {
        code: {"meaning": meaning, "close": answer.close_code, "http": answer.http_status}
        for code, (meaning, answer) in told_errors().items()
    }
    return told


def _image() -> dict[str, Any]:
    return {
        "name": "image",
        "summary": "Client: the file of one frame, as a binary message.",
        "description": "A JPEG; image/png and image/webp are accepted as well. At most `max_bytes` and `max_pixels` of"
        " the limits that `ready` tells.",
        "contentType": "image/jpeg",
        "payload": {"type": "string", "format": "binary"},
    }


def _schemas() -> dict[str, Any]:
    """Schemas of the text messages and their parts: clients may leave out what has a default, the service does not."""
    models: list[tuple[type[BaseModel], JsonSchemaMode]] = [
        *((model, "validation") for model in _CLIENT),
        *((model, "serialization") for model in _SERVER),
    ]
    _, schemas = models_json_schema(models, ref_template=f"{_SCHEMAS}{{model}}", schema_generator=_Draft7)
    definitions: dict[str, Any] = schemas["$defs"]
    return definitions
