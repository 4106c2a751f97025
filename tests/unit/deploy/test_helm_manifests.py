"""The manifests of the Helm chart: valid for Kubernetes, hardened, and with settings that the service accepts."""

from __future__ import annotations

import json
import re
from pathlib import Path

import kubernetes_validate
import pytest
import yaml
from helmchart import (
    BASE,
    CHART,
    GPU_VALUES,
    KEY,
    ROOT,
    VALUES,
    VARIANTS,
    container,
    environment,
    manifests,
    of_kind,
    pod,
    rendered,
    run_helm,
)

from lanestream import __version__
from lanestream.keys import parse_keys
from lanestream.settings import Settings, load_settings

# The oldest version of Kubernetes that the chart accepts, and the newest one with known schemas.
KUBERNETES = ("1.30", "1.37")
# Their schemas are not part of Kubernetes.
CUSTOM_KINDS = {"ServiceMonitor", "PrometheusRule", "ScaledObject", "HTTPRoute"}
OTHER_VARIABLES = {
    "FORWARDED_ALLOW_IPS",
    "OTEL_EXPORTER_OTLP_ENDPOINT",
    "OTEL_TRACES_SAMPLER",
    "OTEL_TRACES_SAMPLER_ARG",
}
COMPOSE = yaml.safe_load((ROOT / "docker/compose.yaml").read_text())


@pytest.mark.parametrize("variant", VARIANTS)
def test_helm_finds_no_fault(variant: str) -> None:
    result = run_helm("lint", "--strict", values=VARIANTS[variant])
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize("version", KUBERNETES)
def test_manifests_follow_the_schemas_of_kubernetes(version: str) -> None:
    distinct = {json.dumps(manifest, sort_keys=True) for variant in VARIANTS for manifest in manifests(variant)}
    builtin = [manifest for manifest in map(json.loads, distinct) if manifest["kind"] not in CUSTOM_KINDS]
    assert len({manifest["kind"] for manifest in builtin}) == 8
    for manifest in builtin:
        kubernetes_validate.validate(manifest, version, strict=True)


def test_the_schemas_refuse_a_misspelled_field() -> None:
    service = json.loads(json.dumps(of_kind("cpu", "Service")))
    service["spec"]["selectr"] = {}
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(service, KUBERNETES[-1], strict=True)


@pytest.mark.parametrize("variant", VARIANTS)
def test_kinds_depend_on_the_values(variant: str) -> None:
    kinds = {manifest["kind"] for manifest in manifests(variant)}
    assert {"Deployment", "Service", "ServiceAccount", "PodDisruptionBudget"} <= kinds
    assert ("Ingress" in kinds) == (variant in ("ingress", "everything"))
    assert ("HTTPRoute" in kinds) == (variant == "gateway")
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
        assert name in OTHER_VARIABLES or name.removeprefix("LANESTREAM_").lower() in Settings.model_fields
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


def test_variables_of_other_programs_are_documented() -> None:
    page = (ROOT / "docs/operations.md").read_text()
    assert all(name in page for name in OTHER_VARIABLES)
    traces = environment("traces")
    assert {*traces} & OTHER_VARIABLES == {name for name in OTHER_VARIABLES if name.startswith("OTEL_")}
    assert (traces["OTEL_TRACES_SAMPLER"], traces["OTEL_TRACES_SAMPLER_ARG"]) == ("traceidratio", "0.001")


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
