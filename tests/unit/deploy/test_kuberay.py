"""The manifest for KubeRay: pods that are valid for Kubernetes, settings and options that exist."""

from __future__ import annotations

import json
import re
import tomllib
import warnings
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from packaging.requirements import Requirement

from lanestream.cluster.options import ClusterOptions
from lanestream.cluster.ray_variables import RAY_VARIABLES
from lanestream.errors import SettingsError
from lanestream.settings import Settings

ROOT = Path(__file__).parents[3]
MANIFEST: dict[str, Any] = yaml.safe_load((ROOT / "deploy/kuberay/lanestream.yaml").read_text())
CLUSTER = MANIFEST["spec"]["rayClusterConfig"]
GROUPS = [CLUSTER["headGroupSpec"], *CLUSTER["workerGroupSpecs"]]
CONFIG: dict[str, Any] = yaml.safe_load(MANIFEST["spec"]["serveConfigV2"])
(APPLICATION,) = CONFIG["applications"]


@pytest.mark.parametrize("version", ["1.30", "1.37"])
@pytest.mark.parametrize("group", GROUPS, ids=["head", "workers"])
def test_the_pods_follow_the_schema_of_kubernetes(group: dict[str, Any], version: str) -> None:
    metadata = {"name": "pod", **group["template"].get("metadata", {})}
    pod = {"apiVersion": "v1", "kind": "Pod", "metadata": metadata, "spec": group["template"]["spec"]}
    kubernetes_validate.validate(json.loads(json.dumps(pod)), version, strict=True)


@pytest.mark.parametrize("group", GROUPS, ids=["head", "workers"])
def test_all_pods_have_the_variables_of_ray(group: dict[str, Any]) -> None:
    (container,) = group["template"]["spec"]["containers"]
    variables = {each["name"]: each["value"] for each in container["env"]}
    assert {name: variables.get(name) for name in RAY_VARIABLES} == RAY_VARIABLES
    assert variables.keys() - RAY_VARIABLES.keys() == {"FORWARDED_ALLOW_IPS"}
    assert {"serve", "metrics"} <= {port["name"] for port in container["ports"]}
    assert not group["template"]["spec"]["enableServiceLinks"]


def test_the_image_has_a_version_of_ray_that_the_package_accepts() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    (ray,) = (each for each in map(Requirement, extras["cluster"]) if each.name == "ray")
    assert CLUSTER["rayVersion"] in ray.specifier
    assert CLUSTER["headGroupSpec"]["template"]["spec"]["containers"][0]["image"].endswith(CLUSTER["rayVersion"])


def test_workers_have_room_for_the_replicas() -> None:
    options = ClusterOptions.parse(APPLICATION["args"])
    (workers,) = CLUSTER["workerGroupSpecs"]
    each = float(workers["rayStartParams"]["num-cpus"]) // options.cpus
    assert workers["minReplicas"] * each >= options.min_replicas
    assert workers["maxReplicas"] * each >= options.max_replicas
    drain = Settings.model_fields["drain_s"].default
    assert workers["template"]["spec"]["terminationGracePeriodSeconds"] > drain


def test_settings_in_comments_exist() -> None:
    names = re.findall(r"LANESTREAM_([A-Z_]+[A-Z])", (ROOT / "deploy/kuberay/lanestream.yaml").read_text())
    assert {name.lower() for name in names} <= Settings.model_fields.keys()
    assert len(names) >= 4


def test_an_unknown_option_is_refused() -> None:
    with pytest.raises(SettingsError, match="replicas is not an option of a cluster"):
        ClusterOptions.parse({**APPLICATION["args"], "replicas": 3})


def test_serve_accepts_the_configuration_and_builds_the_application(monkeypatch: pytest.MonkeyPatch) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        schema = pytest.importorskip("ray.serve.schema", reason="needs Ray")
        from ray._common.utils import import_attr
        from ray.serve import Application
        from ray.serve._private.api import call_user_app_builder_with_args_if_necessary as build

        deployment = schema.ServeDeploySchema.model_validate(CONFIG)
        assert [each.name for each in deployment.applications] == ["lanestream"]
        monkeypatch.setenv("LANESTREAM_REDIS_URL", "redis://127.0.0.1:1/0")
        assert isinstance(build(import_attr(APPLICATION["import_path"]), APPLICATION["args"]), Application)
        monkeypatch.delenv("LANESTREAM_REDIS_URL")
        with pytest.raises(SettingsError, match="more than one replica needs Redis"):
            build(import_attr(APPLICATION["import_path"]), APPLICATION["args"])
