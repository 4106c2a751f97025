"""Real frames: where they are, or why the tests that need them are skipped."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

_BESIDE = Path(__file__).parents[3] / "shared" / "data"


@pytest.fixture(scope="session")
def data() -> Path:
    root = Path(os.environ.get("LANESTREAM_DATA", _BESIDE))
    if not (root / "tusimple" / "labels.jsonl").is_file():
        pytest.skip(f"no labelled real frames in {root}; set LANESTREAM_DATA")
    return root
