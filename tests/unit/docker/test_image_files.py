"""The files of the container image, checked without a container engine."""

from __future__ import annotations

import importlib.util
import json
import re
import tomllib
from pathlib import Path
from types import ModuleType

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from lanestream.settings import Settings

ROOT = Path(__file__).parents[3]
DOCKER = ROOT / "docker"


def script(name: str) -> ModuleType:
    """Imports a script of docker/, which is not a package."""
    spec = importlib.util.spec_from_file_location(name, DOCKER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def instructions() -> list[tuple[str, str]]:
    """Returns the Dockerfile's instructions in order, each with its arguments, with continued lines joined."""
    text = (DOCKER / "Dockerfile").read_text().replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [(name, " ".join(rest.split())) for name, _, rest in (line.partition(" ") for line in lines)]


def values(instruction: str) -> list[str]:
    return [rest for name, rest in instructions() if name == instruction]


def test_the_image_has_a_cpu_and_a_gpu_target_and_a_configurable_base() -> None:
    assert instructions()[0][0] == "ARG"
    assert instructions()[0][1].startswith("BASE_IMAGE=")
    stages = {rest.split()[-1]: rest.split()[0] for rest in values("FROM")}
    assert stages["cpu"] == stages["gpu"] == "runtime"
    assert stages["runtime"] == stages["builder"] == "${BASE_IMAGE}"


def test_the_image_runs_as_a_numbered_non_root_user() -> None:
    (user,) = values("USER")
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", user)


@pytest.mark.parametrize("instruction", ["ENTRYPOINT", "CMD", "HEALTHCHECK"])
def test_commands_run_without_a_shell_so_that_signals_reach_them(instruction: str) -> None:
    (value,) = values(instruction)
    assert isinstance(json.loads(value[value.index("[") :]), list)


def test_copied_files_exist_and_are_not_ignored() -> None:
    ignored = (ROOT / ".dockerignore").read_text().split()
    for rest in values("COPY"):
        if rest.startswith("--from"):
            continue
        for source in rest.split()[:-1]:
            assert (ROOT / source).exists(), source
            assert f"!{source}" in ignored


def locked(variant: str) -> dict[str, Version]:
    """Returns the versions in a lock file for Python 3.11, by package."""
    text = (DOCKER / f"requirements-{variant}.txt").read_text().replace("\\\n", " ")
    lines = [line.partition("--hash")[0] for line in text.splitlines() if line and not line.lstrip().startswith("#")]
    found = [Requirement(line) for line in lines]
    environment = {**default_environment(), "python_version": "3.11", "python_full_version": "3.11.17"}
    used = [each for each in found if each.marker is None or each.marker.evaluate(environment)]
    return {canonicalize_name(each.name): Version(str(each.specifier).removeprefix("==")) for each in used}


def requirements(variant: str) -> list[Requirement]:
    """Returns the requirements in pyproject.toml that `make lock` locks: of a variant of the image, or of its build."""
    table = tomllib.loads((ROOT / "pyproject.toml").read_text())
    if variant == "build":
        return [Requirement(line) for line in table["build-system"]["requires"]]
    (command,) = re.findall(rf"(--extra .*) -o docker/requirements-{variant}\.txt", (ROOT / "Makefile").read_text())
    project = table["project"]
    extras = [project["optional-dependencies"][extra] for extra in re.findall(r"--extra (\S+)", command)]
    return [Requirement(line) for lines in (project["dependencies"], *extras) for line in lines]


@pytest.mark.parametrize("variant", ["cpu", "gpu", "build"])
def test_the_locked_packages_satisfy_the_requirements(variant: str) -> None:
    versions = locked(variant)
    needed = requirements(variant)
    assert needed
    for each in needed:
        assert versions[canonicalize_name(each.name)] in each.specifier, f"run `make lock`: {each}"


@pytest.mark.parametrize("variant", ["cpu", "gpu", "build"])
def test_every_locked_package_has_a_version_and_hashes(variant: str) -> None:
    text = (DOCKER / f"requirements-{variant}.txt").read_text().replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.lstrip().startswith("#")]
    for line in lines:
        assert re.fullmatch(r"[a-z0-9.-]+==[\w.]+( ; [^#]+?)?( +--hash=sha256:[0-9a-f]{64})+", line), line
    assert len(lines) >= len(locked(variant)) > 0


def test_the_image_installs_locked_packages_only() -> None:
    installs = [rest for rest in values("RUN") if " install " in rest]
    for rest in installs:
        assert "--require-hashes" in rest or "--no-deps --no-index" in rest, rest
    assert len(installs) == 2
    used = {name for rest in values("RUN") for name in re.findall(r"requirements-(\w+)\.txt", rest)}
    assert used == {"cpu", "gpu", "build"}
    assert '"--require-hashes"' in (DOCKER / "dependencies.py").read_text()


@pytest.mark.parametrize("runtime", ["cpu", "gpu"])
def test_the_image_has_one_runtime_and_no_torch(runtime: str) -> None:
    names = set(locked(runtime))
    assert len([name for name in names if name.startswith("onnxruntime")]) == 1
    assert not {"torch", "torchvision", "lanestream"} & names
    assert not {"filterpy", "scipy", "matplotlib"} & names, "the service needs none of them"
    assert {"fastapi", "uvicorn", "pydantic", "redis"} <= names


def test_unused_files_are_removed(tmp_path: Path) -> None:
    removed = ["numpy/tests/test_x.py", "scipy/stats/tests/data/y.npy", "openvino/libs/libopenvino_intel_gpu_plugin.so"]
    kept = ["numpy/testing/__init__.py", "numpy/core.py", "openvino/libs/libopenvino_intel_cpu_plugin.so"]
    for name in [*removed, *kept]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    script("dependencies").prune(tmp_path)
    left = [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()]
    assert sorted(left) == sorted(kept)


def test_the_base_image_has_a_supported_python() -> None:
    supported = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"].removeprefix(">=")
    base = re.search(r"python:(\d+)\.(\d+)\.\d+-", values("ARG")[0])
    assert base is not None, "an exact version"
    assert tuple(map(int, base.groups())) >= tuple(map(int, supported.split(".")))


def test_links_targets_and_settings_in_the_deployment_page_exist() -> None:
    page = ROOT / "docs/deployment.md"
    text = page.read_text()
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert (page.parent / target).exists(), target
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert set(re.findall(r"\bmake ([a-z-]+)(?= |`|$)", text)) <= set(targets)
    assert {name.lower() for name in re.findall(r"LANESTREAM_([A-Z_]+)", text)} - {"publish"} <= set(
        Settings.model_fields
    )
