"""The Helm chart, rendered by Helm and checked against the schemas of Kubernetes. No cluster is needed."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import chart
import jsonschema_rs
import kubernetes_validate
import pytest
import yaml
from helm import HelmError, helm

from lanestream import __version__
from lanestream.api import create_app
from lanestream.api.metrics import Metrics
from lanestream.keys import new_key, parse_keys
from lanestream.settings import Settings, load_settings
from lanestream_client.overlays import draw_lanes

ROOT = Path(__file__).parents[3]
CHART = ROOT / "deploy/helm/lanestream"
PAGE = (ROOT / "docs/kubernetes.md").read_text()
COMPOSE = yaml.safe_load((ROOT / "docker/compose.yaml").read_text())
VALUES: dict[str, Any] = yaml.safe_load((CHART / "values.yaml").read_text())
GPU_VALUES: dict[str, Any] = yaml.safe_load((CHART / "values-gpu.yaml").read_text())
# The oldest version of Kubernetes that the chart accepts, and the newest one with known schemas.
KUBERNETES = ("1.30", "1.37")

_, KEY = new_key("camera-7")
ENTRY = str(KEY)
BASE: dict[str, Any] = {
    "image": {"repository": "registry.example.com/lanestream"},
    "apiKeys": {"entries": [ENTRY]},
}
INGRESS = {"enabled": True, "host": "lanes.example.com", "tlsSecret": "lanes-tls"}
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
def program() -> Path:
    try:
        return helm()
    except HelmError as error:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(error))


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


@pytest.mark.parametrize("variant", VARIANTS)
def test_helm_finds_no_fault(variant: str) -> None:
    result = run_helm("lint", "--strict", values=VARIANTS[variant])
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize("version", KUBERNETES)
def test_manifests_follow_the_schemas_of_kubernetes(version: str) -> None:
    distinct = {json.dumps(manifest, sort_keys=True) for variant in VARIANTS for manifest in manifests(variant)}
    builtin = [manifest for manifest in map(json.loads, distinct) if manifest["kind"] not in CUSTOM_SCHEMAS]
    assert len({manifest["kind"] for manifest in builtin}) == 8
    for manifest in builtin:
        kubernetes_validate.validate(manifest, version, strict=True)


def test_the_schemas_refuse_a_misspelled_field() -> None:
    service = json.loads(json.dumps(of_kind("cpu", "Service")))
    service["spec"]["selectr"] = {}
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(service, KUBERNETES[-1], strict=True)


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


@pytest.mark.parametrize("variant", VARIANTS)
def test_kinds_depend_on_the_values(variant: str) -> None:
    kinds = {manifest["kind"] for manifest in manifests(variant)}
    assert {"Deployment", "Service", "ServiceAccount", "PodDisruptionBudget"} <= kinds
    assert ("Ingress" in kinds) == (variant in ("ingress", "everything"))
    assert ("HorizontalPodAutoscaler" in kinds) == (variant == "hpa")
    assert ("ScaledObject" in kinds) == (variant == "keda")
    assert ("PrometheusRule" in kinds) == (variant in ("hpa", "keda"))
    assert ("NetworkPolicy" in kinds) == (variant != "no-redis")
    assert ("Secret" in kinds) == (variant not in ("secrets", "no-keys"))


@pytest.mark.parametrize("variant", VARIANTS)
def test_names_are_unique_and_selectors_find_the_pods_of_one_component(variant: str) -> None:
    names = [(manifest["kind"], manifest["metadata"]["name"]) for manifest in manifests(variant)]
    assert len(set(names)) == len(names)
    deployments = [manifest for manifest in manifests(variant) if manifest["kind"] == "Deployment"]
    for deployment in deployments:
        labels = deployment["spec"]["template"]["metadata"]["labels"]
        component = labels["app.kubernetes.io/component"]
        assert deployment["spec"]["selector"]["matchLabels"] == labels
        assert of_kind(variant, "Service", component)["spec"]["selector"] == labels
    assert len({str(each["spec"]["selector"]) for each in deployments}) == len(deployments)


@pytest.mark.parametrize("variant", VARIANTS)
def test_pods_meet_the_restricted_pod_security_standard(variant: str) -> None:
    for manifest in manifests(variant):
        if manifest["kind"] != "Deployment":
            continue
        spec = manifest["spec"]["template"]["spec"]
        assert spec["securityContext"]["runAsNonRoot"] is True
        assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        assert spec["automountServiceAccountToken"] is False
        assert spec["enableServiceLinks"] is False
        assert not {"hostNetwork", "hostPID", "hostIPC"} & set(spec)
        assert {kind for volume in spec["volumes"] for kind in volume} <= {"name", "emptyDir", "secret", "configMap"}
        for each in spec["containers"]:
            assert each["securityContext"] == {
                "readOnlyRootFilesystem": True,
                "allowPrivilegeEscalation": False,
                "capabilities": {"drop": ["ALL"]},
            }
            assert "memory" in each["resources"]["limits"]
            assert {volume["name"] for volume in spec["volumes"]} == {mount["name"] for mount in each["volumeMounts"]}
    assert of_kind(variant, "ServiceAccount")["automountServiceAccountToken"] is False


def test_users_are_those_of_the_images() -> None:
    (user,) = re.findall(r"^USER (\d+):(\d+)$", (ROOT / "docker/Dockerfile").read_text(), flags=re.MULTILINE)
    for component, ids in (("service", user), ("redis", COMPOSE["services"]["redis"]["user"].split(":"))):
        context = pod("cpu", component)["securityContext"]
        assert (context["runAsUser"], context["runAsGroup"]) == tuple(map(int, ids))
    # Or the keys of a Secret could not be read.
    assert pod("cpu")["securityContext"]["fsGroup"] == int(user[1])


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_grace_period_is_longer_than_pre_stop_and_drain(variant: str) -> None:
    drain = float(environment(variant).get("LANESTREAM_DRAIN_S", Settings().drain_s))
    pre_stop = container(variant)["lifecycle"]["preStop"]["sleep"]["seconds"]
    assert pre_stop + drain + 10 <= pod(variant)["terminationGracePeriodSeconds"] <= pre_stop + drain + 20


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_service_accepts_its_variables(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    variables = environment(variant)
    assert len(variables) == len(container(variant)["env"])
    for name, value in variables.items():
        assert name == "FORWARDED_ALLOW_IPS" or name.removeprefix("LANESTREAM_").lower() in Settings.model_fields
        monkeypatch.setenv(name, value)
    settings = load_settings()
    assert settings.port == container(variant)["ports"][0]["containerPort"]
    for name, given in {**VALUES["settings"], **VARIANTS[variant].get("settings", {})}.items():
        found = getattr(settings, name)
        assert (str(found) if isinstance(found, Path) else found) == (
            tuple(given) if isinstance(given, list) else given
        )
    assert settings.provider == ("cuda" if variant == "gpu" else "auto")
    assert (settings.redis_url is None) == (variant == "no-redis")
    assert (settings.api_keys_file is None) == (variant == "no-keys")
    assert (settings.token_secret is not None) == (variant == "secrets")


def test_a_setting_of_the_provider_takes_precedence() -> None:
    values = {**VARIANTS["gpu"], "settings": {"provider": "auto"}}
    (deployment,) = [
        each
        for each in rendered(values)
        if each["kind"] == "Deployment" and each["metadata"]["name"] == "lanes-lanestream"
    ]
    variables = deployment["spec"]["template"]["spec"]["containers"][0]["env"]
    assert [each["value"] for each in variables if each["name"] == "LANESTREAM_PROVIDER"] == ["auto"]


@pytest.mark.parametrize("release", ["lanestream", "lanes", "l" * 53])
def test_no_service_name_becomes_a_setting(release: str) -> None:
    """Kubernetes sets NAME_PORT and others for each Service of the namespace in the pods that don't refuse it."""
    settings = {f"LANESTREAM_{name}".upper() for name in Settings.model_fields}
    services = [each for each in rendered(BASE, release) if each["kind"] == "Service"]
    assert len(services) == 2
    for service in services:
        prefix = service["metadata"]["name"].upper().replace("-", "_")
        assert len(prefix) <= 63
        assert not {f"{prefix}_{end}" for end in ("PORT", "SERVICE_HOST", "SERVICE_PORT")} & settings


def test_secret_keys_are_mounted_as_the_service_reads_them() -> None:
    secret = of_kind("cpu", "Secret")
    assert parse_keys(secret["stringData"]["api_keys"].splitlines(), "line") == (KEY,)
    for variant, name in (("cpu", secret["metadata"]["name"]), ("secrets", "keys")):
        (volume,) = [each for each in pod(variant)["volumes"] if "secret" in each]
        assert volume["secret"]["secretName"] == name
        (mount,) = [each for each in container(variant)["volumeMounts"] if each["name"] == volume["name"]]
        # Kubernetes never updates a mounted subPath.
        assert "subPath" not in mount
        (item,) = volume["secret"]["items"]
        assert f"{mount['mountPath']}/{item['path']}" == environment(variant)["LANESTREAM_API_KEYS_FILE"]
        assert volume["secret"]["defaultMode"] == 0o440


def application_paths() -> set[str]:
    app = create_app(None, Settings(), draw_lanes)
    return {
        *app.openapi()["paths"],
        *(path for route in app.routes if (path := getattr(route, "path", None)) is not None),
    }


def test_probes_request_existing_paths() -> None:
    probes = {name: container("cpu")[f"{name}Probe"]["httpGet"] for name in ("startup", "readiness", "liveness")}
    assert {name: probe["path"] for name, probe in probes.items()} == {
        "startup": "/readyz",
        "readiness": "/readyz",
        "liveness": "/healthz",
    }
    assert {probe["path"] for probe in probes.values()} <= application_paths()


def test_the_ingress_leads_to_everything_but_the_metrics() -> None:
    (rule,) = of_kind("ingress", "Ingress")["spec"]["rules"]
    rules = [(path["path"], path["pathType"]) for path in rule["http"]["paths"]]

    def reachable(path: str) -> bool:
        return any(path == given or (kind == "Prefix" and path.startswith(f"{given}/")) for given, kind in rules)

    paths = application_paths() | {"/static", "/swagger"}
    assert {path for path in paths if not reachable(path)} == {"/metrics"}
    assert all(any(path == given or path.startswith(f"{given}/") for path in paths) for given, _ in rules)


def test_the_ingress_suits_websockets_and_large_images() -> None:
    for variant, limit in (("ingress", 16 << 20), ("everything", Settings().max_bytes)):
        annotations = of_kind(variant, "Ingress")["metadata"]["annotations"]
        prefix = "nginx.ingress.kubernetes.io/proxy-"
        assert limit < int(annotations[f"{prefix}body-size"]) <= limit + (1 << 20)
        assert int(annotations[f"{prefix}read-timeout"]) > Settings().idle_s
        assert int(annotations[f"{prefix}send-timeout"]) > Settings().idle_s
    assert annotations["cert-manager.io/cluster-issuer"] == "letsencrypt"
    values = {**BASE, "ingress": {**INGRESS, "annotations": {f"{prefix}read-timeout": "3600"}}}
    (ingress,) = [each for each in rendered(values) if each["kind"] == "Ingress"]
    assert ingress["metadata"]["annotations"][f"{prefix}read-timeout"] == "3600"


@pytest.mark.parametrize("variant", VARIANTS)
def test_ports_agree(variant: str) -> None:
    for component in ("service", "redis"):
        services = [each for each in manifests(variant) if each["kind"] == "Service"]
        if not any(each["metadata"]["labels"]["app.kubernetes.io/component"] == component for each in services):
            continue
        (port,) = container(variant, component)["ports"]
        (service_port,) = of_kind(variant, "Service", component)["spec"]["ports"]
        assert service_port["targetPort"] == service_port["name"] == port["name"]
        if variant != "no-redis":
            (rule,) = of_kind(variant, "NetworkPolicy", component)["spec"]["ingress"]
            assert [each["port"] for each in rule["ports"]] == [port["containerPort"]]
    probes = [container(variant)[f"{name}Probe"]["httpGet"]["port"] for name in ("startup", "readiness", "liveness")]
    assert set(probes) == {"http"}


def test_network_policies_allow_dns_and_redis_only() -> None:
    def destinations(variant: str) -> list[tuple[int, ...]]:
        rules = of_kind(variant, "NetworkPolicy")["spec"]["egress"]
        return [tuple(port["port"] for port in rule["ports"]) for rule in rules]

    assert destinations("cpu") == destinations("own-redis") == [(53, 53), (6379,)]
    labels = of_kind("cpu", "Service", "redis")["spec"]["selector"]
    assert of_kind("cpu", "NetworkPolicy")["spec"]["egress"][1]["to"] == [{"podSelector": {"matchLabels": labels}}]
    assert of_kind("own-redis", "NetworkPolicy")["spec"]["egress"][1]["to"] == [{"ipBlock": {"cidr": "10.1.0.0/16"}}]
    alone = rendered({**BASE, "redis": {"enabled": False}})
    (policy,) = [each for each in alone if each["kind"] == "NetworkPolicy"]
    assert policy["spec"]["egress"] == []
    redis = of_kind("cpu", "NetworkPolicy", "redis")["spec"]
    assert redis["policyTypes"] == ["Ingress", "Egress"]
    assert redis["egress"] == []
    clients = [{"podSelector": {"matchLabels": of_kind("cpu", "Service")["spec"]["selector"]}}]
    assert [rule["from"] for rule in redis["ingress"]] == [clients]


def test_redis_runs_as_with_compose() -> None:
    redis = COMPOSE["services"]["redis"]
    assert container("cpu", "redis")["command"] == redis["command"]
    assert container("cpu", "redis")["image"] == redis["image"]
    service = of_kind("cpu", "Service", "redis")
    port = service["spec"]["ports"][0]["port"]
    assert environment("cpu")["LANESTREAM_REDIS_URL"] == f"redis://{service['metadata']['name']}:{port}/0"


def test_redis_outlives_an_upgrade() -> None:
    """No version of the service may be in its pod, or an upgrade of the service would restart it and lose sessions."""
    assert __version__ not in json.dumps(of_kind("cpu", "Deployment", "redis")["spec"])


def test_images_have_the_version_of_the_service() -> None:
    metadata = yaml.safe_load((CHART / "Chart.yaml").read_text())
    assert metadata["version"] == metadata["appVersion"] == __version__
    repository = BASE["image"]["repository"]
    assert container("cpu")["image"] == f"{repository}:{__version__}-cpu"
    assert container("gpu")["image"] == f"{repository}:{__version__}-gpu"
    assert container("secrets")["image"] == f"{repository}@sha256:{'0' * 64}"


def test_a_gpu_pod_has_one_gpu_and_waits_for_none_that_an_old_pod_holds() -> None:
    assert container("gpu")["resources"]["limits"] == {**GPU_VALUES["resources"]["limits"], "nvidia.com/gpu": "1"}
    assert "nvidia.com/gpu" not in container("cpu")["resources"]["limits"]
    strategies = {variant: of_kind(variant, "Deployment")["spec"]["strategy"] for variant in ("cpu", "gpu")}
    assert strategies["gpu"]["rollingUpdate"] == {"maxUnavailable": 1, "maxSurge": 0}
    assert strategies["cpu"]["rollingUpdate"] == {"maxUnavailable": 0, "maxSurge": 1}


def test_generated_files_are_up_to_date() -> None:
    for path, text in chart.generated_files().items():
        assert path.read_text() == text, f"{path.name}: run `make chart`"


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
        ({"metrics": {"serviceMonitor": {"enabled": True}}}, "keySecret.name is missing"),
        ({"metrics": SCRAPED, "settings": {"metrics_access": "off"}}, "settings.metrics_access is off"),
        ({"autoscaling": {"kind": "keda"}}, "autoscaling.prometheusUrl is missing"),
        ({"autoscaling": {"kind": "vpa"}}, "at '/autoscaling/kind'"),
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


def documented(heading: str) -> dict[str, Any]:
    """Returns the YAML of the first block of the page after a line that contains `heading`."""
    block = re.search(rf"{re.escape(heading)}.*?^```yaml\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE)
    assert block is not None
    content: dict[str, Any] = yaml.safe_load(block[1])
    return content


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
