"""Reads the code blocks of the documentation, and the commands in them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    *sorted(page.relative_to(ROOT).as_posix() for page in (ROOT / "docs").rglob("*.md")),
]
SHELL = {"", "bash", "console", "sh"}

_FENCE = re.compile(r"^(?P<indent> *)```(?P<language>\w*)\n(?P<text>.*?)^ *```$", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """A fenced block of a page: the `language` after its fence, and its text."""

    page: str
    line: int
    language: str
    text: str

    @property
    def is_synopsis(self) -> bool:
        """Whether it lists what commands accept: they have options in brackets."""
        return self.language in SHELL and "[--" in self.text

    @property
    def file_name(self) -> str | None:
        """The name of the file that the block shows: a comment in its first line."""
        found = re.match(r"# ([\w-]+\.\w+)$", self.text.split("\n", 1)[0])
        return found[1] if found else None


def blocks(page: str) -> Iterator[Block]:
    """Yields the blocks of a page."""
    text = (ROOT / page).read_text(encoding="utf-8")
    for found in _FENCE.finditer(text):
        code = re.sub(f"^{found['indent']}", "", found["text"], flags=re.MULTILINE)
        yield Block(page, text.count("\n", 0, found.start()) + 1, found["language"], code)


def commands(block: Block) -> list[str]:
    """Returns the commands of a shell's block, without comments. Where some have a prompt, the rest is output."""
    lines = block.text.replace("\\\n", " ").splitlines()
    if any(line.startswith("$ ") for line in lines):
        lines = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
    bare = (re.sub(r"(^|\s+)# .*", "", line) for line in lines)
    return [" ".join(line.split()) for line in bare if line.strip()]


def synopses(block: Block) -> list[str]:
    """Returns one line for each command of a synopsis, whose continued lines are indented."""
    text = re.sub(r"\s+# .*", "", block.text)
    return [" ".join(line.split()) for line in re.sub(r"\n +", " ", text).splitlines()]
