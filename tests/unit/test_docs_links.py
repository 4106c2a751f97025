"""The relative links of all pages lead to files that exist, and their anchors to headings."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
IGNORED = {"out", ".venv", "node_modules"}
PAGES = sorted(
    page.relative_to(ROOT).as_posix()
    for page in ROOT.rglob("*.md")
    if not any(part in IGNORED or part.startswith(".") for part in page.relative_to(ROOT).parts)
)


def prose(page: Path) -> str:
    """Returns the text of a page without its blocks of code."""
    return re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def links(page: Path) -> Iterator[tuple[Path, str]]:
    """Yields the file and the anchor of each link that is not a URL."""
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if not re.match(r"[a-z]+:", target):
            path, _, anchor = target.partition("#")
            yield (page.parent / path if path else page), anchor


def anchors(page: Path) -> set[str]:
    """Returns the anchors of a page as GitHub makes them of its headings."""
    headings = re.findall(r"^#+ +(.+?) *$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_somewhere(name: str) -> None:
    for path, anchor in links(ROOT / name):
        assert path.exists(), f"{name}: no file {path}"
        assert not anchor or anchor in anchors(path), f"{name}: {path.name} has no heading #{anchor}"


def test_every_page_can_be_found() -> None:
    linked = {path.resolve() for name in PAGES for path, _ in links(ROOT / name)}
    linked.add((ROOT / "docs" / "index.md").resolve())  # the front page of the site
    assert [page for page in (ROOT / "docs").glob("*.md") if page.resolve() not in linked] == []
