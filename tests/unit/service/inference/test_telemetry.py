"""No telemetry: unless it is switched off, onnxruntime keeps a device id and a store of events in the home folder."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize("module", ["lanestream.engine", "lanestream.doctor", "lanestream_exporter.exporting.graph"])
def test_telemetry_is_off_before_onnxruntime_is_imported(module: str, tmp_path: Path) -> None:
    # In continuous integration onnxruntime sends nothing anyway.
    kept = {name: value for name, value in os.environ.items() if name not in {"CI", "ORT_DISABLE_TELEMETRY"}}
    home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    subprocess.run([sys.executable, "-c", f"import {module}"], env=kept | home, check=True)
    assert not list(tmp_path.rglob("onnxruntime*"))


def test_a_users_own_setting_is_kept(tmp_path: Path) -> None:
    program = "import lanestream.inference, os; print(os.environ['ORT_DISABLE_TELEMETRY'])"
    environment = os.environ | {"ORT_DISABLE_TELEMETRY": "0", "CI": "true", "HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "0"
