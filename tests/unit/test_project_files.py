"""CITATION.cff, CHANGELOG.md and the package have one version."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

from lanestream import __version__

ROOT = Path(__file__).parents[2]
RELEASES = re.findall(r"^## (\S+) - (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert (citation["cff-version"], citation["version"]) == ("1.2.0", __version__)
    assert [(citation["version"], str(citation["date-released"]))] == RELEASES[:1]


def test_the_changelog_lists_versions_from_the_newest_on() -> None:
    headings = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[0] == "Unreleased"
    assert len(headings) == len(RELEASES) + 1
    versions = [tuple(map(int, version.split("."))) for version, _ in RELEASES]
    assert versions == sorted(versions, reverse=True)
