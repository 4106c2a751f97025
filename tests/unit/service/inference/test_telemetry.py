"""Nobody is told what we run: onnxruntime keeps a device id and a store of events at home where it is not stopped."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize("module", ["lanestream.engine", "lanestream.doctor", "lanestream_exporter.exporting.graph"])
def test_onnxruntime_is_stopped_from_telling_before_it_is_imported(module: str, tmp_path: Path) -> None:
    # In continuous integration onnxruntime is quiet by itself.
    kept = {name: value for name, value in os.environ.items() if name not in {"CI", "ORT_DISABLE_TELEMETRY"}}
    home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    subprocess.run([sys.executable, "-c", f"import {module}"], env=kept | home, check=True)
    assert not list(tmp_path.rglob("onnxruntime*"))


def test_whoever_wants_to_tell_may(tmp_path: Path) -> None:
    said = "import lanestream.inference, os; print(os.environ['ORT_DISABLE_TELEMETRY'])"
    environment = os.environ | {"ORT_DISABLE_TELEMETRY": "0", "CI": "true", "HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", said], env=environment, check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "0"
