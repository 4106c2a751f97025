"""The scripts behind `make up`, with programs in the place of docker and podman. `make up-check` runs them for real."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

DOCKER = Path(__file__).parents[3] / "docker"
TOOLS = ("sh", "sed", "dirname", "head", "mkdir", "chmod", "cat", "tr", "mv", "sleep")


class Machine:
    """A machine with the scripts of docker/ and some programs, which log how they are called."""

    def __init__(self, folder: Path) -> None:
        self.scripts = folder / "docker"
        self._programs = folder / "bin"
        self._log = folder / "log"
        for each in (self.scripts, self._programs):
            each.mkdir()
        for name in ("compose", "up", "make-secrets"):
            shutil.copy(DOCKER / name, self.scripts)
        for name in TOOLS:
            (self._programs / name).symlink_to(shutil.which(name) or name)

    def install(self, program: str, script: str = "") -> None:
        """Installs a program that runs the cases of `script` for its arguments, and succeeds for all others."""
        path = self._programs / program
        path.write_text(f'#!/bin/sh\necho "{program} $*" >>{self._log}\ncase "$*" in\n{script}\nesac\n')
        path.chmod(0o755)

    def run(self, *command: str, **variables: str) -> subprocess.CompletedProcess[str]:
        environment = {"PATH": str(self._programs), **variables}
        return subprocess.run(
            [self.scripts / command[0], *command[1:]], env=environment, capture_output=True, text=True, check=False
        )

    def calls(self) -> list[str]:
        return self._log.read_text().replace(f"{self.scripts}/", "").splitlines()


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


NETAVARK = 'info*) echo "netavark" ;;'
KEY = '*" key "*) echo "key: lane_x"; echo "setting: name:hash" ;;'
FILE = "-f compose.yaml --profile cpu"


def test_docker_runs_its_own_compose(machine: Machine) -> None:
    machine.install("docker")
    assert machine.run("compose", "docker", "cpu", "up", "--detach").returncode == 0
    assert machine.calls()[-1] == f"docker compose {FILE} up --detach"


@pytest.mark.parametrize("version", ["1.4.1", "1.6.0", "2.0.0"])
def test_podman_runs_podman_compose(machine: Machine, version: str) -> None:
    machine.install("podman", NETAVARK)
    machine.install("podman-compose", f'--version) echo "podman-compose version {version}" ;;')
    assert machine.run("compose", "podman", "cpu", "down").returncode == 0
    assert machine.calls()[-1] == f"podman-compose {FILE} down"


def test_podman_without_podman_compose_runs_its_provider(machine: Machine) -> None:
    machine.install("podman", NETAVARK)
    assert machine.run("compose", "podman", "cpu", "down").returncode == 0
    assert machine.calls()[-1] == f"podman compose {FILE} down"


@pytest.mark.parametrize(
    ("programs", "engine", "message"),
    [
        ({}, "docker", "docker is not installed"),
        ({"docker": "compose*) exit 1 ;;"}, "docker", "install the Compose plugin, 2.24 or later"),
        ({"podman": NETAVARK + "\ncompose*) exit 125 ;;"}, "podman", "podman-compose is not installed"),
        ({"podman": 'info*) echo "cni" ;;'}, "podman", "install netavark and aardvark-dns"),
        (
            {"podman": NETAVARK, "podman-compose": '--version) echo "podman-composer version  1.0.3" ;;'},
            "podman",
            "podman-compose 1.0.3 is too old",
        ),
        (
            {"podman": NETAVARK, "podman-compose": '--version) echo "podman-compose version: 1.0.6" ;;'},
            "podman",
            "podman-compose 1.0.6 is too old",
        ),
    ],
)
def test_what_is_missing_is_one_line(machine: Machine, programs: dict[str, str], engine: str, message: str) -> None:
    for program, script in programs.items():
        machine.install(program, script)
    result = machine.run("compose", engine, "cpu", "version")
    assert result.returncode == 1
    assert message in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_up_creates_secrets_waits_and_prints_the_published_ports(machine: Machine) -> None:
    ports = '"ps "*service=grafana) echo two ;;\n"ps "*) echo one ;;\n'
    ports += '"port one 8000") echo 0.0.0.0:80 ;;\n"port two 3000") echo 127.0.0.1:3001 ;;\n"inspect "*) echo 0 ;;\n'
    machine.install("docker", f'{ports}*" exec "*) [ -e "$FLAG" ] || {{ : >"$FLAG"; exit 1; }} ;;\n{KEY}')
    result = machine.run("up", "docker", "cpu", FLAG=str(machine.scripts / "flag"))
    assert result.returncode == 0, result.stderr
    assert f"service: http://0.0.0.0:80, key in {machine.scripts}/secrets/local_key" in result.stdout
    assert f"dashboard: http://127.0.0.1:3001, user admin, password in {machine.scripts}/secrets/" in result.stdout
    assert (machine.scripts / "secrets/local_key").read_text() == "lane_x\n"
    calls = machine.calls()
    assert calls.index("docker run --rm lanestream:cpu key local") < calls.index(f"docker compose {FILE} up --detach")
    assert sum(" exec -T lanestream " in call for call in calls) == 2


def test_up_ends_early_with_the_log_if_the_service_keeps_ending(machine: Machine) -> None:
    log = '*" logs --tail 5 lanestream-gpu") echo "error: LANESTREAM_MAX_SESIONS is not a setting" ;;'
    machine.install("docker", f'"ps "*) echo one ;;\n"inspect "*) echo 3 ;;\n*" exec "*) exit 1 ;;\n{log}\n{KEY}')
    result = machine.run("up", "docker", "gpu")
    assert result.returncode == 1
    assert "LANESTREAM_MAX_SESIONS is not a setting" in result.stderr
    assert result.stderr.endswith("error: the service is not ready; its last log lines are above\n")
    assert os.access(machine.scripts / "secrets/api_keys", os.R_OK)


def test_up_starts_nothing_without_compose(machine: Machine) -> None:
    machine.install("docker", f"compose*) exit 1 ;;\n{KEY}")
    result = machine.run("up", "docker", "cpu")
    assert result.returncode == 1
    assert "install the Compose plugin" in result.stderr
