"""Real frames: where they are, or why the tests that need them are skipped."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

_BESIDE = Path(__file__).parents[3] / "shared" / "data"


@pytest.fixture(scope="session")
def data() -> Path:
    """Labelled real frames; a folder that LANESTREAM_DATA names has to hold them."""
    named = os.environ.get("LANESTREAM_DATA")
    if not named and not _BESIDE.is_dir():
        pytest.skip("no labelled real frames: LANESTREAM_DATA is not set")
    return Path(named) if named else _BESIDE
