"""Fixtures with data sets: a folder to draw images into, and a rendered drive with its labels."""

from __future__ import annotations

from pathlib import Path

import pytest
from labelfiles import Draw, drawer, write_drive


@pytest.fixture
def draw(tmp_path: Path) -> Draw:
    return drawer(tmp_path)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rendered")
    write_drive(folder)
    return folder
