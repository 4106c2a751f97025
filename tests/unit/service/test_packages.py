"""Packages that own the same module, and modules that lack their files."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import cv2
import numpy as np
import pytest

from lanestream import packages
from lanestream.detection.features import find_edges
from lanestream.errors import MissingExtraError, needs_extra, needs_whole_packages
from lanestream.packages import package_conflicts
from lanestream.road.camera import Lens


@pytest.mark.parametrize(
    ("installed", "expected"),
    [
        ({}, []),
        ({"opencv-python-headless": "4.14", "onnxruntime": "1.27"}, []),
        (
            {"opencv-python-headless": "4.14", "opencv-python": "5.0", "onnxruntime": "1.27"},
            [
                "opencv-python-headless 4.14 and opencv-python 5.0 are both the module cv2, so that one overwrites the "
                "other; `pip uninstall opencv-python-headless opencv-python`, then `pip install opencv-python-headless`"
            ],
        ),
        (
            {"onnxruntime": "1.27", "onnxruntime-gpu": "1.26"},
            [
                "onnxruntime-gpu 1.26 and onnxruntime 1.27 are both the module onnxruntime, so that one overwrites the "
                "other; `pip uninstall onnxruntime-gpu onnxruntime`, then `pip install onnxruntime-gpu`"
            ],
        ),
    ],
)
def test_packages_that_own_one_module_conflict(
    installed: dict[str, str], expected: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def version(name: str) -> str:
        if name not in installed:
            raise PackageNotFoundError
        return installed[name]

    monkeypatch.setattr(packages, "version", version)
    assert list(package_conflicts()) == expected


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "module 'cv2' has no attribute 'imdecode'"),
        ("raise ImportError('libGL.so.1: cannot open', name='cv2')", "libGL.so.1: cannot open"),
        (
            "raise ImportError('numpy.core.multiarray failed to\\nimport', name='cv2.cv2')",
            "numpy.core.multiarray failed",
        ),
    ],
)
def test_a_module_that_cannot_be_used_is_one_line(
    content: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cv2.py").write_text(content)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "cv2")
    with pytest.raises(MissingExtraError) as caught, needs_extra("video"):
        importlib.import_module("cv2").imdecode  # noqa: B018 - as at the top of a module
    assert caught.value.message.startswith(f"the package cv2 can't be used: {reason}")
    assert caught.value.hint.endswith("then `pip install opencv-python-headless`")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["InferenceSession", "get_available_providers"])
def test_faults_of_our_own_modules_are_not_hidden(name: str) -> None:
    with pytest.raises(AttributeError), needs_whole_packages():
        getattr(packages, name)
    with pytest.raises(AttributeError), needs_whole_packages():
        getattr("text", name)


@pytest.mark.parametrize(
    ("module", "command"),
    [("cv2", ["detect", "x.jpg"]), ("cv2", ["doctor"]), ("onnxruntime", ["serve", "--port", "0"])],
)
def test_commands_say_what_cannot_be_used(module: str, command: list[str], tmp_path: Path) -> None:
    package = tmp_path / "packages" / module
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (tmp_path / "x.jpg").touch()
    done = subprocess.run(
        [sys.executable, "-m", "lanestream.cli", *command],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(package.parent)}, capture_output=True, text=True,
        check=False, timeout=60,
    )  # fmt: skip
    lines = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert (done.returncode, len(lines), "Traceback" in done.stderr) == (1, 1, False), done.stderr
    assert f"the package {module} can't be used" in lines[0]
    assert f"`pip uninstall {module.replace('cv2', 'opencv-python-headless')}" in lines[0]


def test_edges_are_the_same_with_opencv_5(monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.zeros((90, 160), np.uint8)
    image[:, 60:70] = 200
    expected = find_edges(image, 10)
    find = cv2.findNonZero
    monkeypatch.setattr(cv2, "findNonZero", lambda found: find(found).reshape(-1, 2))
    edges = find_edges(image, 10)
    assert len(edges.x) > 100
    for name in ("x", "y", "angle", "weight"):
        np.testing.assert_array_equal(getattr(edges, name), getattr(expected, name))


def test_rays_are_the_same_with_opencv_5(monkeypatch: pytest.MonkeyPatch) -> None:
    lens = Lens(900.0, 910.0, 640.0, 360.0, (-0.3, 0.1, 0.001, -0.001, 0.02))
    pixels = np.array([[100.0, 200.0], [1200.0, 700.0]])
    expected = lens.rays(pixels)
    four = cv2.undistortPointsIter

    def five(src, matrix, distortion, dst=None, R=None, P=None, criteria=None):  # noqa: N803 - OpenCV's names
        return four(src, matrix, distortion, R, P, criteria)

    monkeypatch.delattr(cv2, "undistortPointsIter")
    monkeypatch.setattr(cv2, "undistortPoints", five)
    np.testing.assert_array_equal(lens.rays(pixels), expected)


def test_doctor_reports_what_conflicts(monkeypatch: pytest.MonkeyPatch) -> None:
    from lanestream.doctor import diagnose, diagnosis_tables
    from lanestream.settings import Settings

    monkeypatch.setattr("lanestream.doctor.package_conflicts", lambda: ("a and b",))
    diagnosis = diagnose(Settings(model=Path("missing.onnx")))
    assert diagnosis.conflicts == ("a and b",)
    (machine,) = diagnosis_tables(diagnosis)
    assert [str(cell) for cell in machine.columns[0].cells].count("conflict") == 1
    assert json.dumps(diagnosis.software)
