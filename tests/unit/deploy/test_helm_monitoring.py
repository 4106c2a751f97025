"""The resources of the Helm chart for the Prometheus operator, and its autoscalers."""

from __future__ import annotations

import json
import re
from typing import Any

import jsonschema_rs
import pytest
import yaml
from helmchart import ROOT, VALUES, VARIANTS, application_paths, documented, of_kind

from lanestream.api.metrics import Metrics


def _closed(**properties: Any) -> dict[str, Any]:
    """Returns the schema of an object that has these properties, all of them and no other."""
    return {"type": "object", "additionalProperties": False, "required": [*properties], "properties": properties}


STRING = {"type": "string", "minLength": 1}
LABELS = {"type": "object", "additionalProperties": STRING}
# What the chart uses of the custom resources of the Prometheus operator and KEDA.
CUSTOM_SCHEMAS = {
    "ServiceMonitor": _closed(
        jobLabel=STRING,
        selector=_closed(matchLabels=LABELS),
        endpoints={
            "type": "array",
            "minItems": 1,
            "items": {
                **_closed(
                    port=STRING,
                    path=STRING,
                    interval={"type": "string", "pattern": r"^\d+s$"},
                    authorization=_closed(type={"const": "Bearer"}, credentials=_closed(name=STRING, key=STRING)),
                ),
                "required": ["port", "path", "interval"],
            },
        },
    ),
    "PrometheusRule": _closed(
        groups={
            "type": "array",
            "minItems": 1,
            "items": _closed(
                name=STRING,
                rules={
                    "type": "array",
                    "minItems": 1,
                    "items": _closed(**{"alert": STRING, "expr": STRING, "for": STRING, "annotations": LABELS}),
                },
            ),
        }
    ),
    "ScaledObject": _closed(
        scaleTargetRef=_closed(name=STRING),
        minReplicaCount={"type": "integer"},
        maxReplicaCount={"type": "integer"},
        pollingInterval={"type": "integer"},
        advanced=_closed(horizontalPodAutoscalerConfig=_closed(behavior={"type": "object"})),
        triggers={
            "type": "array",
            "minItems": 1,
            "items": _closed(
                type={"const": "prometheus"},
                metricType={"enum": ["AverageValue", "Value"]},
                # KEDA accepts strings only.
                metadata=_closed(serverAddress=STRING, query=STRING, threshold=STRING, ignoreNullValues=STRING),
            ),
        },
    ),
}
API_VERSIONS = {"ServiceMonitor": "monitoring.coreos.com/v1", "PrometheusRule": "monitoring.coreos.com/v1"}


@pytest.mark.parametrize(
    ("variant", "kind"),
    [("hpa", "ServiceMonitor"), ("no-keys", "ServiceMonitor"), ("hpa", "PrometheusRule"), ("keda", "ScaledObject")],
)
def test_custom_resources_have_the_expected_fields(variant: str, kind: str) -> None:
    manifest = of_kind(variant, kind)
    assert manifest["apiVersion"] == API_VERSIONS.get(kind, "keda.sh/v1alpha1")
    jsonschema_rs.validate(CUSTOM_SCHEMAS[kind], manifest["spec"])


def test_alerts_are_those_of_compose() -> None:
    groups = yaml.safe_load((ROOT / "docker/prometheus/alerts.yaml").read_text())["groups"]
    assert of_kind("hpa", "PrometheusRule")["spec"]["groups"] == groups
    # The alerts select the job by this name.
    monitor, service = of_kind("hpa", "ServiceMonitor")["spec"], of_kind("hpa", "Service")
    assert service["metadata"]["labels"][monitor["jobLabel"]] == "lanestream"
    assert 'job="lanestream"' in json.dumps(groups).replace("\\", "")


def test_prometheus_scrapes_the_service_with_its_key() -> None:
    monitor, service = of_kind("hpa", "ServiceMonitor")["spec"], of_kind("hpa", "Service")
    assert monitor["selector"]["matchLabels"].items() <= service["metadata"]["labels"].items()
    (endpoint,) = monitor["endpoints"]
    assert endpoint["port"] == service["spec"]["ports"][0]["name"]
    assert endpoint["path"] in application_paths()
    assert endpoint["authorization"]["credentials"] == {"name": "keys", "key": "prometheus_key"}
    assert "authorization" not in of_kind("no-keys", "ServiceMonitor")["spec"]["endpoints"][0]


def test_autoscalers_agree() -> None:
    autoscaler, scaled = of_kind("hpa", "HorizontalPodAutoscaler")["spec"], of_kind("keda", "ScaledObject")["spec"]
    name = of_kind("hpa", "Deployment")["metadata"]["name"]
    assert autoscaler["scaleTargetRef"]["name"] == scaled["scaleTargetRef"]["name"] == name
    values = VALUES["autoscaling"]
    assert autoscaler["minReplicas"] == scaled["minReplicaCount"] == values["minReplicas"]
    assert autoscaler["maxReplicas"] == scaled["maxReplicaCount"] == values["maxReplicas"]
    behavior = scaled["advanced"]["horizontalPodAutoscalerConfig"]["behavior"]
    assert autoscaler["behavior"] == behavior == values["behavior"]
    targets = [metric["pods"]["target"]["averageValue"] for metric in autoscaler["metrics"]]
    assert targets == [trigger["metadata"]["threshold"] for trigger in scaled["triggers"]] == ["5", "0.25"]
    # An upgrade must not reset the number of pods.
    for variant in VARIANTS:
        assert ("replicas" in of_kind(variant, "Deployment")["spec"]) == (variant not in ("hpa", "keda"))


def _series(query: str) -> set[str]:
    return set(re.findall(r"\blane_\w+", query))


def test_autoscalers_query_existing_series() -> None:
    metrics = Metrics()
    metrics.frame_processed({"decode": 1.0}, 0.1)
    existing = _series(metrics.exposition().decode())
    adapter = documented("**With `hpa`**")["rules"]["custom"]
    queries = [trigger["metadata"]["query"] for trigger in of_kind("keda", "ScaledObject")["spec"]["triggers"]]
    queries += [rule[field].replace("<<.Series>>", "") for rule in adapter for field in ("seriesQuery", "metricsQuery")]
    assert set.union(*map(_series, queries)) == {"lane_sessions_active", "lane_frame_age_seconds_bucket"} <= existing
    wanted = [
        metric["pods"]["metric"]["name"] for metric in of_kind("hpa", "HorizontalPodAutoscaler")["spec"]["metrics"]
    ]
    assert [rule["name"]["as"] for rule in adapter] == wanted
