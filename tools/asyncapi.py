"""Writes the contract of the stream as an AsyncAPI document, and validates it where there is a schema to do it with.

python tools/asyncapi.py docs/asyncapi.yaml [SCHEMA]     SCHEMA: schemas/3.0.0.json of the npm package @asyncapi/specs
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import jsonschema_rs
import yaml

from lanestream.asyncapi import document


def written() -> str:
    """The document as YAML, in the order that it is made in."""
    head = "# Made from the models in service/lanestream/protocol.py: `make asyncapi`.\n"
    return head + yaml.safe_dump(document(), sort_keys=False, allow_unicode=True, width=120)


def main(out: Path, schema: Path | None = None) -> None:
    """Writes the document to `out`. Ends with its first fault where `schema` finds one."""
    if schema is not None:
        faults = jsonschema_rs.validator_for(json.loads(schema.read_text())).iter_errors(document())
        for fault in faults:
            sys.exit(f"not AsyncAPI: {'/'.join(map(str, fault.instance_path))}: {fault.message[:500]}")
    out.write_text(written())


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
