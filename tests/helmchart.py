"""The Helm chart, rendered by Helm with the values of several variants."""

from __future__ import annotations

import json
import os
import re
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from helm import HelmError, helm

from lanestream.api import create_app
from lanestream.keys import new_key
from lanestream.settings import Settings
from lanestream_client.overlays import draw_lanes

ROOT = Path(__file__).parents[1]
CHART = ROOT / "deploy/helm/lanestream"
PAGE = (ROOT / "docs/kubernetes.md").read_text()
VALUES: dict[str, Any] = yaml.safe_load((CHART / "values.yaml").read_text())
GPU_VALUES: dict[str, Any] = yaml.safe_load((CHART / "values-gpu.yaml").read_text())

_, KEY = new_key("camera-7")
ENTRY = str(KEY)
BASE: dict[str, Any] = {
    "image": {"repository": "registry.example.com/lanestream"},
    "apiKeys": {"entries": [ENTRY]},
}
INGRESS = {"enabled": True, "host": "lanes.example.com", "tlsSecret": "lanes-tls"}
GATEWAY = {
    "enabled": True,
    "host": "lanes.example.com",
    "parentRefs": [{"name": "public", "namespace": "gateways", "sectionName": "https"}],
}
SCRAPED = {"serviceMonitor": {"enabled": True, "keySecret": {"name": "keys"}}, "prometheusRule": {"enabled": True}}
VARIANTS: dict[str, dict[str, Any]] = {
    "cpu": BASE,
    "gpu": {**GPU_VALUES, **BASE, "runtimeClassName": "nvidia"},
    "no-redis": {**BASE, "redis": {"enabled": False}, "networkPolicy": {"enabled": False}},
    "own-redis": {
        **BASE,
        "redis": {"enabled": False, "existingSecret": "redis"},
        "networkPolicy": {"redis": [{"ipBlock": {"cidr": "10.1.0.0/16"}}]},
    },
    "no-keys": {
        "image": BASE["image"],
        "apiKeys": {"enabled": False},
        "metrics": {"serviceMonitor": {"enabled": True}},
    },
    "secrets": {
        "image": {**BASE["image"], "digest": f"sha256:{'0' * 64}", "pullSecrets": [{"name": "registry"}]},
        "apiKeys": {"existingSecret": "keys"},
        "tokenSecret": {"existingSecret": "keys"},
    },
    "hpa": {**BASE, "autoscaling": {"kind": "hpa"}, "metrics": SCRAPED},
    "keda": {**BASE, "autoscaling": {"kind": "keda", "prometheusUrl": "http://prometheus:9090"}, "metrics": SCRAPED},
    "ingress": {**BASE, "ingress": INGRESS, "trustedProxies": "10.0.0.0/8", "settings": {"max_bytes": 16 << 20}},
    "gateway": {**BASE, "gateway": GATEWAY},
    "traces": {
        **BASE,
        "tracing": {"endpoint": "http://collector.monitoring:4318", "sampleRatio": 0.001},
        "networkPolicy": {"collector": [{"podSelector": {"matchLabels": {"app": "collector"}}}]},
    },
    "everything": {
        **BASE,
        "ingress": {**INGRESS, "annotations": {"cert-manager.io/cluster-issuer": "letsencrypt"}},
        "preStopSeconds": 20,
        "settings": {"drain_s": 45.5, "bytes_per_s": 512e6, "kinds": ["marking"], "live_page": False, "camera": "/c/a"},
        "podAnnotations": {"example.com/team": "roads"},
        "nodeSelector": {"kubernetes.io/arch": "amd64"},
        "tolerations": [{"key": "lanes", "operator": "Exists"}],
        "affinity": {"nodeAffinity": {}},
        "priorityClassName": "high",
        "extraVolumes": [{"name": "cameras", "configMap": {"name": "cameras"}}],
        "extraVolumeMounts": [{"name": "cameras", "mountPath": "/c"}],
    },
}
Manifest = dict[str, Any]


@cache
def _find_helm() -> Path | HelmError:
    try:
        return helm()
    except HelmError as error:
        return error


def program() -> Path:
    """Returns the path of Helm. Without it, the test is skipped; in CI, it fails."""
    found = _find_helm()
    if isinstance(found, Path):
        return found
    if os.environ.get("CI"):
        raise found
    pytest.skip(str(found))


def run_helm(*arguments: str, values: dict[str, Any]) -> subprocess.CompletedProcess[str]:
    """Runs Helm on the chart with `values`, and returns its exit status and output."""
    command = [program(), *arguments, str(CHART), "--values", "-"]
    return subprocess.run(command, input=json.dumps(values), capture_output=True, text=True, check=False)


def rendered(values: dict[str, Any], release: str = "lanes") -> list[Manifest]:
    result = run_helm("template", release, "--namespace", "roads", values=values)
    assert result.returncode == 0, result.stderr
    return [manifest for manifest in yaml.safe_load_all(result.stdout) if manifest]


@cache
def manifests(variant: str) -> list[Manifest]:
    return rendered(VARIANTS[variant])


def of_kind(variant: str, kind: str, component: str = "service") -> Manifest:
    """Returns the manifest of a kind for the service or for Redis."""
    (found,) = [
        manifest
        for manifest in manifests(variant)
        if manifest["kind"] == kind and manifest["metadata"]["labels"]["app.kubernetes.io/component"] == component
    ]
    return found


def pod(variant: str, component: str = "service") -> dict[str, Any]:
    spec: dict[str, Any] = of_kind(variant, "Deployment", component)["spec"]["template"]["spec"]
    return spec


def container(variant: str, component: str = "service") -> dict[str, Any]:
    (found,) = pod(variant, component)["containers"]
    return dict(found)


def environment(variant: str) -> dict[str, str]:
    """Returns the variables of the service's container, with a made-up value for each one from a Secret."""
    secrets = {"token_secret": "s" * 32, "redis_url": "rediss://:password@redis.example.com:6379/0"}
    return {
        entry["name"]: entry["value"] if "value" in entry else secrets[entry["valueFrom"]["secretKeyRef"]["key"]]
        for entry in container(variant)["env"]
    }


def application_paths() -> set[str]:
    app = create_app(None, Settings(), draw_lanes)
    return {
        *app.openapi()["paths"],
        *(path for route in app.routes if (path := getattr(route, "path", None)) is not None),
    }


def documented(heading: str) -> dict[str, Any]:
    """Returns the YAML of the first block of the page after a line that contains `heading`."""
    block = re.search(rf"{re.escape(heading)}.*?^```yaml\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE)
    assert block is not None
    content: dict[str, Any] = yaml.safe_load(block[1])
    return content
