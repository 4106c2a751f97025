"""A short measurement with real nodes, and the check of the simulation against it."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path

import pytest
from capacity import calibration, measurement
from capacity.__main__ import main
from capacity.measurement import Measurement, cases
from click.testing import CliRunner

SHIPPED = Path(calibration.__file__).parent / "calibration.json"


def test_a_node_is_calibrated_and_measured_and_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "_IDLE_S", 0.2)
    monkeypatch.setattr(calibration, "_SAVED_S", 1.5)
    monkeypatch.setattr(calibration, "_SETTLING", 1)
    monkeypatch.setattr(measurement, "_CALIBRATED_FRAMES", 6)
    monkeypatch.setattr(measurement, "_WARM_UP_S", 0.5)
    # Other tests may run beside it.
    monkeypatch.setattr(measurement, "precedence", nullcontext)
    (tmp_path / "calibration-real.json").write_bytes(SHIPPED.read_bytes())
    (case,) = (case for case in cases() if case.name == "waiting-1-latest-2x10")
    said: list[str] = []
    assert Measurement(tmp_path, 2.0, said.append).run(1, [case], None)
    assert said[0] == "calibrating one node, waiting"
    assert said[1].startswith(case.name)

    run = json.loads((tmp_path / "runs" / f"{case.name}-0.json").read_text())
    assert 0.0 < run["answered_per_s"] <= 21.0
    assert 10.0 < run["p50_ms"] <= run["p95_ms"]
    assert run["saves_per_stream_s"] > 0.0
    times = calibration.Calibration.read(tmp_path / "calibration-waiting.json")
    assert len(times.frames) == 6
    # What the detector waits is not computed.
    assert all(each.wait_s > 0.01 for each in times.frames)
    assert times.open_s > 0.0

    result = CliRunner().invoke(main, ["check", "--out", str(tmp_path)])
    assert result.exit_code in (0, 1)
    assert f"| {case.name} | " in result.output
