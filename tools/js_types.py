"""Writes client/js/src/messages.ts: the messages of the service as TypeScript types, from their JSON Schemas.

`make js-types` runs it, after it has installed the packages that it needs in client/js.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any, Final

from pydantic.json_schema import models_json_schema

from lanestream.api.problems import Problem
from lanestream.api.rest import ModelList
from lanestream.protocol import json_schemas

FOLDER: Final = Path(__file__).parents[1] / "client/js"
OUT: Final = FOLDER / "src/messages.ts"


def types() -> str:
    """Returns the content of messages.ts."""
    _, rest = models_json_schema([(ModelList, "serialization"), (Problem, "serialization")])
    client, server = json_schemas().values()
    sent = {name: _complete(schema) for name, schema in (server["$defs"] | rest["$defs"]).items()}
    senders = {"client": client, "server": server}
    schema = {
        "description": "The messages of a stream by who sends them, and the bodies of other responses.",
        "type": "object",
        "properties": {name: {"oneOf": each["oneOf"]} for name, each in senders.items()}
        | {"models": {"$ref": "#/$defs/ModelList"}, "problem": {"$ref": "#/$defs/Problem"}},
        "$defs": client["$defs"] | sent,
    }
    schema = _complete(schema)
    command = ["node", "tools/types.js"]
    text = json.dumps(_for_compiler(schema))
    return subprocess.run(command, cwd=FOLDER, input=text, stdout=subprocess.PIPE, text=True, check=True).stdout


def _complete(schema: dict[str, Any]) -> dict[str, Any]:
    """Returns the schema with all fields required: the service sends those with a default, too."""
    return schema | {"required": list(schema["properties"])}


def _for_compiler(value: Any, in_properties: bool = False) -> Any:
    """Returns a schema without the titles of fields, which would become types, and with tuples as in draft 4."""
    if isinstance(value, list):
        return [_for_compiler(item) for item in value]
    if not isinstance(value, dict):
        return value
    if "prefixItems" in value:
        value = {**value, "items": value["prefixItems"]}
    kept = {key: each for key, each in value.items() if in_properties or key not in ("title", "prefixItems")}
    return {key: _for_compiler(each, in_properties=key in ("properties", "$defs")) for key, each in kept.items()}


if __name__ == "__main__":
    OUT.write_text(types())
