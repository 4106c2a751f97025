"""Reference pages of the site, made from the service's own descriptions of its interfaces."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from lanestream.api import create_app
from lanestream.asyncapi import document
from lanestream.settings import Settings

Schema = Mapping[str, Any]

_REST = """# REST

A running service shows this interface at `/docs`, where it can be tried, and returns the OpenAPI document at
`/openapi.json`. [Errors](../protocol.md#errors) lists the codes of error responses, and [Messages](messages.md) the
fields of `lanes`.
"""
_MESSAGES = """# Messages

The JSON objects of `/v1/stream`. `lanes` is also the answer of `POST /v1/detect`. [The stream protocol](../protocol.md)
says when they are sent and what they mean. The same as data: [asyncapi.yaml](../asyncapi.yaml), and `GET /v1/schema`
and `GET /v1/asyncapi.json` of a running service.
"""
_BOUNDS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}


def rest_page() -> str:
    """Returns the page of the REST interface, from the OpenAPI document."""
    paths: Schema = create_app(None, Settings()).openapi()["paths"]
    operations = (
        (f"{method.upper()} {path}", each) for path, methods in paths.items() for method, each in methods.items()
    )
    return "\n".join([_REST, *(line for name, each in operations for line in _operation(name, each))])


def messages_page() -> str:
    """Returns the page of all messages and their parts, from the AsyncAPI document."""
    components: Schema = document()["components"]
    sent = [message["payload"]["$ref"] for message in components["messages"].values() if "$ref" in message["payload"]]
    messages = [reference.rsplit("/", 1)[-1] for reference in sent]
    parts = sorted(set(components["schemas"]) - set(messages))
    schemas = components["schemas"]
    return "\n".join([_MESSAGES, *(line for name in messages + parts for line in _object(name, schemas[name]))])


def _operation(name: str, operation: Schema) -> Iterator[str]:
    yield f"## `{name}`\n"
    yield f"{operation.get('description', operation['summary'])}\n"
    parameters = operation.get("parameters", [])
    if parameters:
        yield "| parameter | type | |\n| --- | --- | --- |"
        for each in parameters:
            yield _row(f"`{each['name']}`", _type(each["schema"]), each.get("description", ""))
        yield ""
    yield "| status | |\n| --- | --- |"
    for status, response in operation["responses"].items():
        yield _row(status, response["description"])
    yield ""


def _object(name: str, schema: Schema) -> Iterator[str]:
    yield f"## {name}\n"
    yield f"{schema['description']}\n"
    yield "| field | type | |\n| --- | --- | --- |"
    for field, value in schema["properties"].items():
        yield _row(f"`{field}`", _type(value), _description(value))
    yield ""


def _description(schema: Schema) -> str:
    parts = [schema.get("description", ""), *(option.get("description", "") for option in schema.get("anyOf", []))]
    default = schema.get("default")
    return next(filter(None, parts), "") + ("" if default is None else f" Default: `{json.dumps(default)}`.")


def _type(schema: Schema) -> str:
    if "$ref" in schema:
        name = schema["$ref"].rsplit("/", 1)[-1]
        return f"[{name}](messages.md#{name.lower()})"
    for union in ("anyOf", "oneOf"):
        if union in schema:
            return " or ".join(dict.fromkeys(_type(option) for option in schema[union]))
    if "const" in schema:
        return f"`{json.dumps(schema['const'])}`"
    if "enum" in schema:
        return " or ".join(f"`{json.dumps(value)}`" for value in schema["enum"])
    if schema.get("type") == "array":
        return _list_type(schema)
    bounds = [f"{sign} {schema[key]:g}" for key, sign in _BOUNDS.items() if key in schema]
    return str(schema.get("type", "any")) + (f" {', '.join(bounds)}" if bounds else "")


def _list_type(schema: Schema) -> str:
    items = schema["items"]
    return f"list of {len(items)}: {_type(items[0])}" if isinstance(items, list) else f"list: {_type(items)}"


def _row(*cells: str) -> str:
    return "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in cells) + " |"
