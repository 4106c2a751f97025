"""The contract of `/v1/stream` as an AsyncAPI 3.0 document, generated from the models in `protocol`.

It takes the service's point of view: it receives what a client sends.
"""

from __future__ import annotations

from typing import Any, Final, get_args

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaMode, JsonSchemaValue, models_json_schema
from pydantic_core import core_schema

from lanestream import __version__
from lanestream.errors import documented_errors
from lanestream.protocol import KEY_SUBPROTOCOL, SUBPROTOCOL, ClientMessage, Message, ServerMessage

_SCHEMAS: Final = "#/components/schemas/"
_STREAM: Final = "#/channels/stream"
_CLIENT: Final[tuple[type[Message], ...]] = get_args(ClientMessage)
_SERVER: Final[tuple[type[Message], ...]] = get_args(ServerMessage)
# Close codes that do not follow an error; the others belong to the code of an error.
_CLOSE_CODES: Final[dict[int, str]] = {
    1000: "after `summary`",
    1009: "a message is larger than twice the size limit of an image, or a text larger than 64 KB",
    1012: "after `draining`, once every frame that arrived before it was answered",
}


class _Draft7(GenerateJsonSchema):
    """Generates schemas in the dialect that AsyncAPI requires."""

    def tuple_schema(self, schema: core_schema.TupleSchema) -> JsonSchemaValue:
        """Lists the items of a tuple as `items`, where newer dialects use `prefixItems`."""
        generated = super().tuple_schema(schema)
        if "prefixItems" in generated:
            generated["items"] = generated.pop("prefixItems")
        return generated

    def tagged_union_schema(self, schema: core_schema.TaggedUnionSchema) -> JsonSchemaValue:
        """Omits the `discriminator` of OpenAPI, which AsyncAPI defines differently."""
        generated = super().tagged_union_schema(schema)
        generated.pop("discriminator", None)
        return generated


def document() -> dict[str, Any]:
    """Returns the AsyncAPI document as plain values."""
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "Lanestream",
            "version": __version__,
            "description": "Camera frames in, tracked lane lines out. See docs/protocol.md for the protocol in prose.",
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
        "description": "The default address of `lanestream serve`. A service with API keys requires one of the two"
        " security schemes.",
        "security": [{"$ref": f"#/components/securitySchemes/{name}"} for name in _security()],
    }


def _security() -> dict[str, Any]:
    return {
        "header": {"type": "http", "scheme": "bearer", "description": "For programs: `Authorization: Bearer KEY`."},
        "subprotocol": {
            "type": "httpApiKey",
            "in": "header",
            "name": "Sec-WebSocket-Protocol",
            "description": f"For browsers: the subprotocol `{KEY_SUBPROTOCOL}KEY`, in addition to `{SUBPROTOCOL}`.",
        },
    }


def _channel() -> dict[str, Any]:
    headers = {
        "Sec-WebSocket-Protocol": {"type": "string", "description": f"`{SUBPROTOCOL}`, the version of the protocol."},
        "Authorization": {"type": "string", "description": "`Bearer KEY`, if the service requires a key."},
        "Origin": {"type": "string", "description": "The origin of a browser's page, which must be allowed."},
    }
    return {
        "address": "/v1/stream",
        "title": "A stream of frames",
        "description": "The frames of one camera in, the lanes of each frame out. Only `image` is required. It is a"
        " binary message; all others are text messages. The service declines compression, since images are compressed.",
        "servers": [{"$ref": "#/servers/local"}],
        "messages": {name: {"$ref": f"#/components/messages/{name}"} for name in (*_messages(), "image")},
        "bindings": {"ws": {"method": "GET", "headers": {"type": "object", "properties": headers}}},
        "x-subprotocol": SUBPROTOCOL,
        "x-close-codes": {str(code): meaning for code, meaning in sorted(_CLOSE_CODES.items())},
    }


def _operations() -> dict[str, Any]:
    """Returns one operation per client message, named by its type, and one for the messages that answer none."""
    replies = {reply for model in _CLIENT for reply in model.replies}
    unsolicited = [_type(model) for model in _SERVER if _type(model) not in replies]
    received = {
        _type(model): {
            "action": "receive",
            "channel": {"$ref": _STREAM},
            "summary": _summary(model),
            # The binary message with the image belongs to the `frame` message before it.
            "messages": _message_refs(["frame", "image"] if _type(model) == "frame" else [_type(model)]),
            "reply": {"channel": {"$ref": _STREAM}, "messages": _message_refs(model.replies)},
        }
        for model in _CLIENT
    }
    notify = {
        "action": "send",
        "channel": {"$ref": _STREAM},
        "summary": "Messages that answer no message: warnings, fatal errors, and the announcement of a stop.",
        "messages": _message_refs(["error", *unsolicited]),
    }
    return {**received, "notify": notify}


def _message_refs(names: list[str] | tuple[str, ...]) -> list[dict[str, str]]:
    return [{"$ref": f"{_STREAM}/messages/{name}"} for name in names]


def _messages() -> dict[str, Any]:
    """Returns the text messages by type."""
    messages: dict[str, Any] = {}
    for model in (*_CLIENT, *_SERVER):
        name = _type(model)
        messages[name] = {
            "name": name,
            "summary": _summary(model),
            "payload": {"$ref": f"{_SCHEMAS}{model.__name__}"},
        }
        if model.example is not None:
            messages[name]["examples"] = [{"payload": model.example}]
    messages["error"]["x-codes"] = {
        code: {"meaning": meaning, "close": status.close_code, "http": status.http_status}
        for code, (meaning, status) in documented_errors().items()
    }
    return messages


def _type(model: type[Message]) -> str:
    name: str = model.model_fields["type"].default
    return name


def _summary(model: type[Message]) -> str:
    """Returns the first paragraph of the model's docstring on one line."""
    return " ".join((model.__doc__ or "").split("\n\n")[0].split())


def _image() -> dict[str, Any]:
    return {
        "name": "image",
        "summary": "Client: the image file of one frame, as a binary message.",
        "description": "A JPEG; image/png and image/webp are also accepted. `max_bytes` and `max_pixels` of the limits"
        " in `ready` apply.",
        "contentType": "image/jpeg",
        "payload": {"type": "string", "format": "binary"},
    }


def _schemas() -> dict[str, Any]:
    """Returns the schemas of the text messages and their parts. Clients may omit defaults; the service never does."""
    models: list[tuple[type[Message], JsonSchemaMode]] = [
        *((model, "validation") for model in _CLIENT),
        *((model, "serialization") for model in _SERVER),
    ]
    _, schemas = models_json_schema(models, ref_template=f"{_SCHEMAS}{{model}}", schema_generator=_Draft7)
    definitions: dict[str, Any] = schemas["$defs"]
    return definitions
