"""`make chart`: updates what the Helm chart repeats: the version, the alerts, and the names and types of settings.

python tools/chart.py
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, Final

from lanestream import __version__
from lanestream.settings import Settings

ROOT: Final = Path(__file__).parents[1]
CHART: Final = ROOT / "deploy/helm/lanestream"
# The chart itself sets the port and the paths, and takes secrets from Secrets. The ingress adds TLS.
MANAGED_SETTINGS: Final = frozenset(
    {"config", "port", "tls_certificate", "tls_key", "api_keys", "api_keys_file", "token_secret", "redis_url"}
)


def generated_files() -> dict[Path, str]:
    """Returns the text that each generated file of the chart should have."""
    metadata, schema = CHART / "Chart.yaml", CHART / "values.schema.json"
    versions = re.sub(r"^version: .*$", f"version: {__version__}", metadata.read_text(), flags=re.MULTILINE)
    versions = re.sub(r"^appVersion: .*$", f'appVersion: "{__version__}"', versions, flags=re.MULTILINE)
    document = json.loads(schema.read_text())
    document["properties"]["settings"] = settings_schema()
    return {
        metadata: versions,
        schema: json.dumps(document, indent=2) + "\n",
        CHART / "files/alerts.yaml": (ROOT / "docker/prometheus/alerts.yaml").read_text(),
    }


def settings_schema() -> dict[str, Any]:
    """Returns the JSON schema of the chart's value `settings`: the service's settings without the managed ones."""
    fields = Settings.model_json_schema()["properties"]
    properties = {name: _without_defaults(field) for name, field in fields.items() if name not in MANAGED_SETTINGS}
    return {"type": "object", "additionalProperties": False, "properties": properties}


def _without_defaults(field: dict[str, Any]) -> dict[str, Any]:
    """Returns the schema of a setting that is set: without its default, and without null."""
    (value,) = [each for each in field.get("anyOf", [field]) if each.get("type") != "null"]
    return {
        **({"description": field["description"]} if "description" in field else {}),
        **{key: item for key, item in value.items() if key not in {"default", "title", "format", "description"}},
    }


if __name__ == "__main__":
    for path, text in generated_files().items():
        path.write_text(text)
