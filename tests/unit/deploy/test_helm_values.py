"""The values of the Helm chart: their schema, their defaults and the page that describes them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import chart
import pytest
import yaml
from helmchart import BASE, CHART, ENTRY, GATEWAY, PAGE, SCRAPED, VALUES, documented, rendered, run_helm


def test_generated_files_are_up_to_date() -> None:
    for path, text in chart.generated_files().items():
        assert path.read_text() == text, f"{path.name}: run `make chart`"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"image": {}}, "image.repository is missing"),
        ({"apiKeys": {"entries": []}}, "no API keys: set apiKeys.existingSecret or apiKeys.entries, or"),
        ({"apiKeys": {"entries": [ENTRY], "existingSecret": "keys"}}, "are both set: use one of them"),
        ({"apiKeys": {"entries": ["camera-7"]}}, "at '/apiKeys/entries/0'"),
        ({"redis": {"existingSecret": "redis"}}, "set redis.enabled=false to use your own Redis"),
        ({"networkPolicy": {"enabled": False}}, "this Redis has no password"),
        ({"networkPolicy": {"from": []}}, "at '/networkPolicy/from'"),
        ({"ingress": {"enabled": True, "tlsSecret": "tls"}}, "ingress.host is missing"),
        ({"ingress": {"enabled": True, "host": "lanes.example.com"}}, "ingress.tlsSecret is missing"),
        ({"gateway": {"enabled": True, "host": "lanes.example.com"}}, "gateway.parentRefs is missing"),
        ({"gateway": {**GATEWAY, "host": ""}}, "gateway.host is missing"),
        ({"metrics": {"serviceMonitor": {"enabled": True}}}, "keySecret.name is missing"),
        ({"metrics": SCRAPED, "settings": {"metrics_access": "off"}}, "settings.metrics_access is off"),
        ({"autoscaling": {"kind": "keda"}}, "autoscaling.prometheusUrl is missing"),
        ({"autoscaling": {"kind": "vpa"}}, "at '/autoscaling/kind'"),
        ({"tracing": {"endpoint": "collector:4318"}}, "at '/tracing/endpoint'"),
        ({"replicas": 3}, "additional properties 'replicas' not allowed"),
        ({"settings": {"max_sesions": 3}}, "additional properties 'max_sesions' not allowed"),
        ({"settings": {"max_sessions": 0}}, "at '/settings/max_sessions'"),
        ({"settings": {"redis_url": "redis://:password@redis"}}, "additional properties 'redis_url' not allowed"),
    ],
)
def test_bad_values_are_refused(values: dict[str, Any], message: str) -> None:
    result = run_helm("template", "lanes", values={**BASE, **values})
    assert result.returncode != 0
    assert message in result.stderr


def leaves(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields the dotted name and the default of each value. Objects of Kubernetes are one value."""
    for name, value in values.items():
        nested = isinstance(value, dict) and value and name not in {"resources", "behavior", "settings"}
        yield from leaves(value, f"{prefix}{name}.") if nested else [(f"{prefix}{name}", value)]


def test_the_page_lists_all_values_with_their_defaults() -> None:
    rows = re.findall(r"^\| `([\w.]+)` \| (?:`([^`]*)`)? *\| \S.* \|$", PAGE, flags=re.MULTILINE)
    expected = {name: value for name, value in leaves(VALUES) if value not in ("", [], {})}
    assert [name for name, _ in rows] == [name for name, _ in leaves(VALUES)]
    assert {name: yaml.safe_load(default) for name, default in rows if default} == expected


def test_the_values_on_the_page_can_be_installed() -> None:
    values = documented("## Install")
    kinds = {manifest["kind"] for manifest in rendered(values)}
    assert {"Ingress", "ServiceMonitor", "PrometheusRule"} <= kinds


def test_schema_and_values_have_the_same_names() -> None:
    def names(schema: dict[str, Any], prefix: str = "") -> Iterator[str]:
        for name, item in schema.get("properties", {}).items():
            nested = "properties" in item and name != "settings"
            yield from names(item, f"{prefix}{name}.") if nested else [f"{prefix}{name}"]

    schema = json.loads((CHART / "values.schema.json").read_text())
    assert sorted(set(names(schema)) - {"global"}) == sorted(name for name, _ in leaves(VALUES))
