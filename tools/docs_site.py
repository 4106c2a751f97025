"""MkDocs hooks: pages from elsewhere in the repository or made from the code, and links that work on both sites.

The pages in docs/ link to each other and to other files of the repository by relative paths, as GitHub shows them. On
the site, links to files that are not pages lead to the repository.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from reference_pages import messages_page, rest_page

ROOT = Path(__file__).parents[1]
# Files of the repository that are pages of the site, although they are not in docs/.
ELSEWHERE = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "service/lanestream/models/MODEL_CARD.md": "model-card.md",
}
SOURCES = {page: source for source, page in ELSEWHERE.items()}
_LINK = re.compile(r"(?P<code>^```.*?^```|`[^`\n]*`)|\]\((?P<target>[^)\s]+)\)", re.DOTALL | re.MULTILINE)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages that are not in docs/."""
    for source, page in ELSEWHERE.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / source)))
    files.append(File.generated(config, "reference/rest.md", content=rest_page()))
    files.append(File.generated(config, "reference/messages.md", content=messages_page()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Returns the text of a page with its links as the site needs them."""
    shown = page.file.src_uri
    source = SOURCES.get(shown, f"docs/{shown}")
    repository = f"{config.extra['repository']}/blob/main"

    def link(match: re.Match[str]) -> str:
        if match["target"] is None:
            return match[0]
        return f"]({site_target(match['target'], source, shown, repository)})"

    return _LINK.sub(link, markdown)


def site_target(target: str, source: str, page: str, repository: str) -> str:
    """Returns where a link in the file `source`, shown as `page`, leads on the site.

    Paths count from the root of the repository, and `page` from that of the site.
    """
    path, hash_sign, anchor = target.partition("#")
    if not path or re.match(r"[a-z]+:", target):
        return target
    file = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
    if file in ELSEWHERE or file.startswith("docs/"):
        shown = ELSEWHERE.get(file, file.removeprefix("docs/"))
        return posixpath.relpath(shown, posixpath.dirname(page) or ".") + hash_sign + anchor
    return f"{repository}/{file}{hash_sign}{anchor}"
