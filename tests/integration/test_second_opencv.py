"""Lanestream in an environment where another OpenCV was installed over its own."""

from __future__ import annotations

import json
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path
from textwrap import dedent

import pytest

# Newer than Lanestream requires.
_VERSION = "5.0.0.93"


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the Python of a virtual environment with an opencv-python over the packages of this one."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False)
    packages = folder / "lib" / f"python{sysconfig.get_python_version()}" / "site-packages"
    (packages / "ours.pth").write_text(f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})\n")
    wanted = [f"opencv-python=={_VERSION}", "--no-deps", "--only-binary", ":all:", "--target", str(packages)]
    done = subprocess.run(
        [sys.executable, "-m", "pip", "install", "-q", *wanted],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    if done.returncode:
        pytest.skip(f"opencv-python {_VERSION} can't be installed: {done.stderr.splitlines()[-1]}")
    return folder / "bin" / "python"


def run(python: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [python, "-m", "lanestream.cli", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=120)


def test_lanes_are_found_and_drawn(python: Path, road: bytes, tmp_path: Path) -> None:
    (tmp_path / "road.jpg").write_bytes(road)
    camera = {"height": 1.4, "field_of_view": 60.0, "distortion": [-0.2, 0.05, 0.0, 0.0, 0.0]}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    found = {}
    for each in (Path(sys.executable), python):
        done = run(
            each, tmp_path, "detect", "road.jpg", "--camera", "camera.json", "--jsonl", "-", "--annotate", "drawn"
        )
        assert done.returncode == 0, done.stderr
        lanes = json.loads(done.stdout)
        found[each] = [(lane["position"], lane["ground"] is None) for lane in lanes["lanes"]]
    ours, theirs = found.values()
    assert {(-1, False), (1, False)} <= set(theirs)
    assert theirs == ours
    assert (tmp_path / "drawn" / "road.jpg.lanes.jpg").stat().st_size > 1000


def test_doctor_names_the_packages(python: Path, tmp_path: Path) -> None:
    done = run(python, tmp_path, "doctor", "--json", "--provider", "cpu")
    assert done.returncode == 0, done.stderr
    (conflict,) = json.loads(done.stdout)["conflicts"]
    assert "opencv-python-headless" in conflict
    assert " and opencv-python " in conflict


def test_the_start_of_the_service_names_the_packages(python: Path, tmp_path: Path) -> None:
    script = dedent("""
        import subprocess, sys
        command = [sys.executable, "-m", "lanestream.cli", "serve", "--port", "0"]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as service:
            for line in service.stderr:
                print(line, end="")
                if "listening" in line:
                    break
            service.kill()
    """)
    done = subprocess.run(
        [python, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120
    )
    assert "are both the module cv2" in done.stdout
