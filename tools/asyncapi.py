"""Writes the contract of the stream as an AsyncAPI document. Validates it first if a schema is given.

python tools/asyncapi.py docs/asyncapi.yaml [SCHEMA]     SCHEMA: schemas/3.0.0.json of the npm package @asyncapi/specs
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import jsonschema_rs
import yaml

from lanestream.asyncapi import document


def to_yaml() -> str:
    """Returns the document as YAML, in its own order."""
    head = "# Generated from the models in service/lanestream/protocol.py by `make asyncapi`.\n"
    return head + yaml.safe_dump(document(), sort_keys=False, allow_unicode=True, width=120)


def main(out: Path, schema: Path | None = None) -> None:
    """Writes the document to `out`. Exits with an error if it violates the `schema`."""
    if schema is not None:
        errors = jsonschema_rs.validator_for(json.loads(schema.read_text())).iter_errors(document())
        for error in errors:
            path = "/".join(map(str, error.instance_path))
            sys.exit(f"not a valid AsyncAPI document: {path}: {error.message[:500]}")
    out.write_text(to_yaml())


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
