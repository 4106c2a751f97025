"""The probes, the ingress, the ports and the network policies of the Helm chart."""

from __future__ import annotations

import pytest
from helmchart import BASE, INGRESS, VARIANTS, application_paths, container, manifests, of_kind, rendered

from lanestream.settings import Settings


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


@pytest.mark.parametrize(
    ("endpoint", "port"), [("https://10.1.2.3", 443), ("http://collector/otlp", 80), ("https://collector:4318/", 4318)]
)
def test_the_port_of_the_collector_is_that_of_its_url(endpoint: str, port: int) -> None:
    values = {**BASE, "redis": {"enabled": False}, "tracing": {"endpoint": endpoint}}
    (policy,) = [each for each in rendered(values) if each["kind"] == "NetworkPolicy"]
    assert policy["spec"]["egress"][1:] == [{"ports": [{"port": port, "protocol": "TCP"}]}]


def test_network_policies_allow_dns_redis_and_the_collector_only() -> None:
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
    assert destinations("traces") == [(53, 53), (6379,), (4318,)]
    collector = VARIANTS["traces"]["networkPolicy"]["collector"]
    assert of_kind("traces", "NetworkPolicy")["spec"]["egress"][2]["to"] == collector
    redis = of_kind("cpu", "NetworkPolicy", "redis")["spec"]
    assert redis["policyTypes"] == ["Ingress", "Egress"]
    assert redis["egress"] == []
    clients = [{"podSelector": {"matchLabels": of_kind("cpu", "Service")["spec"]["selector"]}}]
    assert [rule["from"] for rule in redis["ingress"]] == [clients]
