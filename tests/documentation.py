"""Reads tables of keys in the documentation."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator


def table_keys(table: str, base: str = "") -> Iterator[str]:
    """Yields the keys in the first column of a Markdown table, below `base`; `a.{b,c}` stands for `a.b` and `a.c`."""
    for cell in re.findall(r"^\| `([^`]+)` \|", table, flags=re.MULTILINE):
        yield from _expanded(f"{base}.{cell}".lstrip("."))


def _expanded(pattern: str) -> Iterator[str]:
    parts = [part.split(",") for part in re.split(r"[{}]", pattern)]
    fixed = [[",".join(part)] if index % 2 == 0 else part for index, part in enumerate(parts)]
    return map("".join, itertools.product(*fixed))
