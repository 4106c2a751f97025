"""The documentation as a site: it builds without a warning, and shows pages from the internet nowhere."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from docs_site import ELSEWHERE, site_target

import lanestream_client

ROOT = Path(__file__).parents[2]
# What a browser would load by itself.
LOADED = re.compile(
    r"<(?:script|img|iframe|source)[^>]+src=[\"']?(https?:[^\"' >]+)|<link[^>]+href=[\"']?(https?:[^\"' >]+)"
)
REPOSITORY = "https://example.com/blob/main"


def build(config: Path, site: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--config-file", config, "--site-dir", site]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    result = build(ROOT / "mkdocs.yml", folder)
    assert result.returncode == 0, result.stderr
    return folder


def text(page: Path) -> str:
    return re.sub(r"<[^>]+>", "", page.read_text(encoding="utf-8"))


def test_nothing_is_loaded_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 20
    assert [(page.name, match[0]) for page in pages for match in LOADED.finditer(page.read_text())] == []


def test_the_reference_has_the_public_interfaces(site: Path) -> None:
    page = (ROOT / "docs" / "reference" / "python.md").read_text()
    assert sorted(re.findall(r"^::: \S+\.(\w+)$", page, re.MULTILINE)) == sorted(lanestream_client.__all__)
    assert "reconnect_s: float" in text(site / "reference" / "python" / "index.html")
    rest = text(site / "reference" / "rest" / "index.html")
    assert "POST /v1/detect" in rest
    assert "GET /readyz" in rest
    messages = text(site / "reference" / "messages" / "index.html")
    for name in ("StartMessage", "LanesMessage", "CameraModel"):
        assert name in messages


def test_links_out_of_the_site_lead_to_files_of_the_repository(site: Path) -> None:
    found = {
        path
        for page in site.rglob("*.html")
        for path in re.findall(r'href="https://github\.com/lanestream/lanestream/blob/main/([^"#]+)', page.read_text())
    }
    assert "docker/prometheus/alerts.yaml" in found
    assert [path for path in sorted(found) if not (ROOT / path).exists()] == []


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("[gone](gone.md)", "'gone.md', but the target is not found"),
        ("[heading](#gone)", "'#gone', but there is no such anchor"),
        ("", 'not included in the "nav" configuration'),
    ],
    ids=["link", "anchor", "unlisted page"],
)
def test_a_faulty_page_stops_the_build(tmp_path: Path, fault: str, message: str) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text(f"# Title\n\n{fault}\n")
    if not fault:
        (tmp_path / "docs" / "unlisted.md").write_text("# Unlisted\n")
    config = tmp_path / "mkdocs.yml"
    config.write_text(f"INHERIT: {ROOT / 'mkdocs.yml'}\ndocs_dir: docs\nnav: [index.md]\nhooks: []\nplugins: []\n")
    result = build(config, tmp_path / "site")
    assert result.returncode == 1
    assert message in result.stderr


@pytest.mark.parametrize(
    ("target", "source", "page", "expected"),
    [
        ("client.md#sources", "docs/cameras.md", "cameras.md", "client.md#sources"),
        ("../client.md", "docs/reference/python.md", "reference/python.md", "../client.md"),
        ("../README.md", "docs/client.md", "client.md", f"{REPOSITORY}/README.md"),
        ("../CHANGELOG.md", "docs/index.md", "index.md", "changelog.md"),
        (
            "../../../docs/training.md#frames",
            "service/lanestream/models/MODEL_CARD.md",
            "model-card.md",
            "training.md#frames",
        ),
        ("docs/security.md", "CONTRIBUTING.md", "contributing.md", "security.md"),
        ("#limits", "docs/client.md", "client.md", "#limits"),
        ("https://example.com/x.md", "docs/client.md", "client.md", "https://example.com/x.md"),
    ],
)
def test_links_are_led_to_their_page_or_to_the_repository(target: str, source: str, page: str, expected: str) -> None:
    assert site_target(target, source, page, REPOSITORY) == expected


def test_pages_from_elsewhere_exist() -> None:
    assert [path for path in ELSEWHERE if not (ROOT / path).is_file()] == []
