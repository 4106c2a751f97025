"""The systemd unit, checked by systemd itself. The service is not started."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from lanestream.settings import Settings

SYSTEMD = Path(__file__).parents[3] / "deploy/systemd"
UNIT = (SYSTEMD / "lanestream.service").read_text()
PROGRAM = "/opt/lanestream/bin/lanestream"
# On systemd's scale from 0 to 10, in tenths. A service without a sandbox has 96.
MOST_EXPOSURE = 20


def values(name: str) -> list[str]:
    return re.findall(rf"^{name}=(.*)$", UNIT, flags=re.MULTILINE)


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """The unit as installed on a machine, where its program exists."""
    if shutil.which("systemd-analyze") is None:
        if os.environ.get("CI"):
            pytest.fail("CI needs systemd-analyze (on Debian: apt install systemd)")
        pytest.skip("systemd-analyze is not installed")
    program = tmp_path / "lanestream"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    unit = tmp_path / "lanestream.service"
    unit.write_text(UNIT.replace(PROGRAM, str(program)))
    return unit


def analyze(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = shutil.which("systemd-analyze")
    assert command is not None
    return subprocess.run([command, *arguments], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("gpu", [False, True])
def test_systemd_finds_no_fault(installed: Path, gpu: bool) -> None:
    if gpu:
        folder = installed.with_name("lanestream.service.d")
        folder.mkdir()
        shutil.copy(SYSTEMD / "gpu.conf", folder)
    result = analyze("verify", installed)
    assert (result.returncode, result.stderr) == (0, "")


def test_systemd_finds_an_unknown_directive(installed: Path) -> None:
    installed.write_text(installed.read_text().replace("ProtectSystem=", "ProtectSystems="))
    assert "ProtectSystems" in analyze("verify", installed).stderr


def test_the_sandbox_is_tight(installed: Path) -> None:
    result = analyze("security", "--offline=true", f"--threshold={MOST_EXPOSURE}", installed)
    assert result.returncode == 0, result.stdout


def test_variables_are_settings() -> None:
    names = {assignment.partition("=")[0] for line in values("Environment") for assignment in line.split()}
    settings = {name for name in names if name.startswith("LANESTREAM_")}
    assert settings
    assert {name.removeprefix("LANESTREAM_").lower() for name in settings} <= set(Settings.model_fields)


def test_a_reload_reads_the_keys_again() -> None:
    """Without a key file, SIGHUP would stop the service."""
    assert values("ExecReload") == ["/bin/kill -HUP $MAINPID"]
    assert any(line.startswith("LANESTREAM_API_KEYS_FILE=/") for line in values("Environment"))


def test_a_stop_waits_for_the_drain() -> None:
    (timeout,) = values("TimeoutStopSec")
    assert int(timeout) >= Settings().drain_s + 10
    assert values("KillMode") == ["mixed"]


def test_the_program_is_where_the_instructions_install_it() -> None:
    page = (SYSTEMD.parents[1] / "docs/deployment.md").read_text()
    assert values("ExecStart") == [f"{PROGRAM} serve"]
    assert f"{PROGRAM} key " in page
    assert values("EnvironmentFile")[0].removeprefix("-") in page
