"""The compose file and the files for Prometheus and Grafana, checked without a container engine."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import fakes
import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from lanestream.api.metrics import DropReason, Metrics
from lanestream.inference.batcher import BatchReport
from lanestream.keys import find_key, read_keys
from lanestream.settings import Settings
from lanestream.workers.capabilities import Capabilities

ROOT = Path(__file__).parents[3]
DOCKER = ROOT / "docker"
COMPOSE: dict[str, Any] = yaml.safe_load((DOCKER / "compose.yaml").read_text())
DASHBOARD: dict[str, Any] = json.loads((DOCKER / "grafana/dashboards/lanestream.json").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
OWN_SERVICES = ("lanestream", "lanestream-gpu")


@pytest.mark.parametrize("name", SERVICES)
def test_every_container_is_hardened(name: str) -> None:
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["restart"] == "unless-stopped"
    assert service["deploy"]["resources"]["limits"].keys() == {"memory", "pids"}
    assert "privileged" not in service
    # Our own image has a health check.
    assert name in OWN_SERVICES or "test" in service["healthcheck"]


@pytest.mark.parametrize("name", SERVICES)
def test_ports_are_published_on_this_machine_only_by_default(name: str) -> None:
    for port in SERVICES[name].get("ports", []):
        assert re.fullmatch(r"\$\{[A-Z_]+:-127\.0\.0\.1:\d+\}:\d+", port)


@pytest.mark.parametrize("name", sorted(set(SERVICES) - set(OWN_SERVICES)))
def test_third_party_images_are_pinned(name: str) -> None:
    assert re.search(r":v?\d+\.\d+\.\d+\b", SERVICES[name]["image"])


def test_a_profile_starts_one_variant_and_all_its_dependencies() -> None:
    for variant, own in (("cpu", "lanestream"), ("gpu", "lanestream-gpu")):
        started = {name for name, service in SERVICES.items() if variant in service["profiles"]}
        assert started == {own, "redis", "prometheus", "grafana"}
        assert SERVICES[own]["build"]["target"] == variant
    assert SERVICES["lanestream-gpu"]["deploy"]["resources"]["reservations"]["devices"][0]["capabilities"] == ["gpu"]


@pytest.mark.parametrize("name", OWN_SERVICES)
def test_the_environment_contains_only_known_settings(name: str) -> None:
    given = {key.removeprefix("LANESTREAM_").lower() for key in SERVICES[name]["environment"]}
    assert given <= set(Settings.model_fields)


@pytest.mark.parametrize("name", OWN_SERVICES)
def test_the_grace_period_is_longer_than_draining(name: str) -> None:
    grace = float(SERVICES[name]["stop_grace_period"].removesuffix("s"))
    assert grace >= Settings().drain_s + 10


@pytest.mark.parametrize("name", OWN_SERVICES)
def test_connections_are_limited(name: str) -> None:
    limits = SERVICES[name]["ulimits"]["nofile"]
    assert 4096 <= limits["soft"] == limits["hard"]
    value = SERVICES[name]["environment"]["LANESTREAM_MAX_SESSIONS_PER_CALLER"]
    default = re.fullmatch(r"\$\{LANESTREAM_MAX_SESSIONS_PER_CALLER:-(\d+)\}", value)
    assert default is not None
    assert 1 <= int(default[1]) <= Settings().max_sessions / 2


def test_secrets_are_not_committed_and_mounts_exist() -> None:
    ignored = (ROOT / ".gitignore").read_text().split()
    assert "docker/secrets/" in ignored
    assert all(secret["file"].startswith("secrets/") for secret in COMPOSE["secrets"].values())
    for service in SERVICES.values():
        assert set(service.get("secrets", [])) <= set(COMPOSE["secrets"])
        environment = " ".join(map(str, service.get("environment", {}).values()))
        assert set(re.findall(r"/run/secrets/(\w+)", environment)) <= set(service.get("secrets", []))
        for mount in service.get("volumes", []):
            source = mount.split(":")[0]
            assert (DOCKER / source).exists() if source.startswith(".") else source in COMPOSE["volumes"]


def test_prometheus_finds_replicas_by_their_alias() -> None:
    (job,) = yaml.safe_load((DOCKER / "prometheus/prometheus.yaml").read_text())["scrape_configs"]
    (lookup,) = job["dns_sd_configs"]
    for name in OWN_SERVICES:
        assert lookup["names"] == SERVICES[name]["networks"]["metrics"]["aliases"]
        assert str(lookup["port"]) == SERVICES[name]["environment"]["LANESTREAM_PORT"]
    assert job["job_name"] == "lanestream"
    assert Path(job["authorization"]["credentials_file"]).name in SERVICES["prometheus"]["secrets"]


def test_secrets_are_created_once_and_are_valid_keys(tmp_path: Path) -> None:
    script = shutil.copy(DOCKER / "make-secrets", tmp_path)
    secrets = tmp_path / "secrets"

    def run_script() -> dict[str, str]:
        subprocess.run([script, sys.executable, "-m", "lanestream.cli"], check=True, capture_output=True)
        return {path.name: path.read_text().strip() for path in secrets.iterdir()}

    first = run_script()
    assert run_script() == first
    keys = read_keys(secrets / "api_keys")
    for name in ("local", "prometheus"):
        key = find_key(keys, first[f"{name}_key"])
        assert key is not None
        assert key.name == name
    assert len(first["grafana_password"]) == 24
    assert secrets.stat().st_mode & 0o777 == 0o700
    mounted = [secrets / Path(secret["file"]).name for secret in COMPOSE["secrets"].values()]
    assert all(path.stat().st_mode & 0o004 for path in mounted)


def expressions() -> Iterator[str]:
    """Yields every query of the dashboard and of the alerts."""
    yield from (target["expr"] for panel in DASHBOARD["panels"] for target in panel.get("targets", []))
    (group,) = yaml.safe_load((DOCKER / "prometheus/alerts.yaml").read_text())["groups"]
    yield from (rule["expr"] for rule in group["rules"])


def exposition() -> str:
    """Returns the metrics of a service in which everything has happened once."""
    metrics = Metrics()
    for detector in Capabilities.of(fakes.engine()).detectors:
        metrics.loaded(detector)
    metrics.workers(tuple)
    metrics.frame_processed({"decode": 1.0}, 0.1)
    metrics.batch(BatchReport("fake 1", inputs=1, requests=1, still_waiting=0, longest_wait_s=0.0))
    metrics.socket_closed(1000)
    metrics.refused("bad_image")
    return metrics.exposition().decode()


def series() -> dict[str, set[str]]:
    """Returns the labels of every series that Prometheus has of a service, by name."""
    labels_by_name = {"up": set[str]()}
    for family in text_string_to_metric_families(exposition()):
        for sample in family.samples:
            labels_by_name.setdefault(sample.name, set()).update(sample.labels)
    return {name: labels | {"job", "instance"} for name, labels in labels_by_name.items()}


@pytest.mark.parametrize("expression", sorted(set(expressions())))
def test_queries_use_existing_series_and_labels(expression: str) -> None:
    existing = series()
    used = set(re.findall(r"\b(lane_\w+|process_\w+|up)(?=[{\[ ]|$)", expression))
    assert used
    assert used <= set(existing)
    labels = {name for group in re.findall(r"by \(([^)]*)\)", expression) for name in group.split(", ")}
    labels |= set(re.findall(r'(\w+)(?:=~|!=|!~|=)"', expression))
    assert all(labels <= existing[name] for name in used)
    reasons = {reason for group in re.findall(r'reason=~?"([^"]*)"', expression) for reason in group.split("|")}
    assert reasons <= set(get_args(DropReason))


def test_the_dashboard_shows_all_our_metrics() -> None:
    shown = " ".join(expressions())
    for family in text_string_to_metric_families(exposition()):
        assert not family.name.startswith("lane_") or family.name.endswith("_created") or family.name in shown


def test_panels_are_described_and_do_not_overlap() -> None:
    panels = DASHBOARD["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    occupied: set[tuple[int, int]] = set()
    for panel in panels:
        grid = panel["gridPos"]
        cells = {(grid["x"] + x, grid["y"] + y) for x in range(grid["w"]) for y in range(grid["h"])}
        assert not cells & occupied
        assert max(x for x, _ in cells) < 24
        occupied |= cells
        assert panel["type"] == "row" or (panel["title"] and panel["description"] and panel["targets"])


def test_the_dashboard_is_provisioned_from_its_mount() -> None:
    provider = yaml.safe_load((DOCKER / "grafana/provisioning/dashboards/lanestream.yaml").read_text())["providers"][0]
    targets = [mount.split(":")[1] for mount in SERVICES["grafana"]["volumes"]]
    assert provider["options"]["path"] in targets
    source = yaml.safe_load((DOCKER / "grafana/provisioning/datasources/prometheus.yaml").read_text())["datasources"][0]
    assert source["url"] == "http://prometheus:9090"
