"""Finds out that files have changed: API keys and certificates are replaced while the service runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

# Changes with the content of a file, also if another one takes its place; None if the file is missing.
_Version = tuple[int, ...] | None


class FileWatch:
    """Calls `reload` when files that belong together have changed."""

    def __init__(self, files: Sequence[Path], reload: Callable[[], None]) -> None:
        self._files = files
        self._reload = reload
        # Unknown, so that a change before the first look is found, too.
        self._loaded: tuple[_Version, ...] | None = None
        self._previous: tuple[_Version, ...] | None = None

    def versions(self) -> tuple[_Version, ...]:
        """Returns what to pass on to `check`. May take long, with files on a network."""
        return tuple(map(_version, self._files))

    def check(self, found: tuple[_Version, ...], *, force: bool) -> None:
        """Reloads the files if they have changed, or by `force`.

        Files that are still being written may be incomplete, so they must not have changed since the last call.
        """
        if force or (found != self._loaded and found == self._previous):
            self._loaded = found
            self._reload()
        self._previous = found


def _version(path: Path) -> _Version:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size
