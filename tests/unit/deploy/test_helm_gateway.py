"""The HTTPRoute of the Helm chart, checked with the types and schemas of the Gateway API from the npm registry."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from helmchart import BASE, GATEWAY, ROOT, application_paths, documented, manifests, of_kind, rendered

from lanestream.settings import Settings

# The package has the types of Gateway API 1.5 for TypeScript, and validators that were generated from its schemas.
PACKAGES = ("@kubernetes-models/gateway-api@2.0.0", "typescript@7.0.2")
FOLDER = ROOT / "out/gateway-api"
COMPILER = ("--noEmit", "--strict", "--skipLibCheck", "--module", "nodenext", "--target", "es2022")


@pytest.fixture(scope="module")
def packages() -> Path:
    """Returns the folder with the installed packages."""
    if shutil.which("npm") is None:
        pytest.fail("npm is not installed (on Debian: apt install npm)")
    command = ["npm", "install", "--silent", "--no-audit", "--no-fund", "--prefix", str(FOLDER), *PACKAGES]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return FOLDER


def problems(packages: Path, folder: Path, route: dict[str, Any]) -> str:
    """Returns what the compiler says of a misspelled or missing field, and the validator of a wrong value."""
    (folder / "node_modules").symlink_to(packages / "node_modules", target_is_directory=True)
    (folder / "package.json").write_text('{"type": "module"}')
    module = "@kubernetes-models/gateway-api/gateway.networking.k8s.io/v1/HTTPRoute"
    text = json.dumps(route)
    (folder / "route.ts").write_text(
        f'import {{ type IHTTPRoute }} from "{module}";\nconst route: IHTTPRoute = {text};\n'
    )
    (folder / "route.js").write_text(f'import {{ HTTPRoute }} from "{module}";\nnew HTTPRoute({text}).validate();\n')
    commands = (["node_modules/.bin/tsc", *COMPILER, "route.ts"], ["node", "route.js"])
    results = [subprocess.run(each, cwd=folder, capture_output=True, text=True, check=False) for each in commands]
    return "".join(result.stdout + result.stderr for result in results if result.returncode)


def test_the_route_follows_the_gateway_api(packages: Path, tmp_path: Path) -> None:
    assert problems(packages, tmp_path, of_kind("gateway", "HTTPRoute")) == ""


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [("timeots", {}, "timeots"), ("timeouts", {"request": "a day"}, "must match pattern")],
)
def test_a_wrong_route_is_refused(packages: Path, tmp_path: Path, name: str, value: Any, message: str) -> None:
    route = json.loads(json.dumps(of_kind("gateway", "HTTPRoute")))
    route["spec"]["rules"][0][name] = value
    assert message in problems(packages, tmp_path, route)


def test_the_route_leads_to_everything_but_the_metrics() -> None:
    rules = of_kind("gateway", "HTTPRoute")["spec"]["rules"]
    given = [(match["path"]["value"], match["path"]["type"]) for rule in rules for match in rule["matches"]]

    def reachable(path: str) -> bool:
        return any(path == value or (kind == "PathPrefix" and path.startswith(f"{value}/")) for value, kind in given)

    assert {path for path in application_paths() if not reachable(path)} == {"/metrics"}


def test_streams_have_no_timeout_and_bodies_have_time_to_arrive() -> None:
    (streams, others) = of_kind("gateway", "HTTPRoute")["spec"]["rules"]
    assert [match["path"]["value"] for match in streams["matches"]] == ["/v1/stream"]
    assert streams["timeouts"] == {"request": "0s", "backendRequest": "0s"}
    assert int(others["timeouts"]["request"].removesuffix("s")) > Settings().body_s
    slow = rendered({**BASE, "gateway": GATEWAY, "settings": {"body_s": 99.5}})
    (route,) = [each for each in slow if each["kind"] == "HTTPRoute"]
    assert route["spec"]["rules"][1]["timeouts"] == {"request": "130s"}
    without = rendered({**BASE, "gateway": {**GATEWAY, "timeouts": False}})
    (route,) = [each for each in without if each["kind"] == "HTTPRoute"]
    assert not any("timeouts" in rule for rule in route["spec"]["rules"])


def test_the_route_leads_to_the_port_of_the_service() -> None:
    service = of_kind("gateway", "Service")
    ports = {each["port"] for each in service["spec"]["ports"]}
    for rule in of_kind("gateway", "HTTPRoute")["spec"]["rules"]:
        assert [backend["name"] for backend in rule["backendRefs"]] == [service["metadata"]["name"]]
        assert {backend["port"] for backend in rule["backendRefs"]} == ports
    assert {each["kind"] for each in manifests("gateway")}.isdisjoint({"Ingress"})


def test_the_values_on_the_page_create_a_route() -> None:
    values = documented("Gateway has the certificate")
    (route,) = [each for each in rendered({**BASE, **values}) if each["kind"] == "HTTPRoute"]
    assert route["spec"]["parentRefs"] == GATEWAY["parentRefs"]
