"""The long description of the package: README.md with links and pictures that also work outside the repository."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_PAGES = "https://github.com/lanestream/lanestream/blob/main/"
_PICTURES = "https://raw.githubusercontent.com/lanestream/lanestream/main/"
# The target of a Markdown link or picture, or of an attribute of HTML, unless it is a URL or an anchor.
_TARGET = re.compile(r'(\]\(|(?:src|srcset|href)=")(?![a-z]+:|#)([^)"\s]+)')
_PICTURE = re.compile(r"\.(?:gif|jpe?g|png|svg|webp)$")


class ReadmeHook(MetadataHookInterface):
    """Sets the field `readme` of the project."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Adds the description to `metadata`."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {"content-type": "text/markdown", "text": _TARGET.sub(_absolute, text)}


def _absolute(match: re.Match[str]) -> str:
    start, target = match.groups()
    return start + (_PICTURES if _PICTURE.search(target) else _PAGES) + target
