"""The folder of real frames; tests that need them are skipped without it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

_DEFAULT = Path(__file__).parents[3] / "shared" / "data"


@pytest.fixture(scope="session")
def data() -> Path:
    """Returns the folder of labeled real frames; if LANESTREAM_DATA is set, they must be there."""
    named = os.environ.get("LANESTREAM_DATA")
    if not named and not _DEFAULT.is_dir():
        pytest.skip("no labeled real frames: LANESTREAM_DATA is not set")
    return Path(named) if named else _DEFAULT
