"""What a stream needs, and where Redis and proxies saturate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from capacity.memory import measure_stream_needs
from capacity.other_programs import precedence
from capacity.proxies import PROXIES, installed_proxies, measure_proxy
from capacity.redis_limits import measure_redis

# What can be measured.
LIMITS: Final = ("stream", "redis", *PROXIES)
_SESSIONS: Final = 5000
# The size of an answer for the proxies; a frame has the size of the first one.
_ANSWER_BYTES: Final = 5000


def measure_limits(
    names: Sequence[str], frames: Path, folder: Path, seconds: float
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yields the names and figures of what is measured, by default of everything that is installed here.

    `frames` is a folder of JPEG files. Raises RuntimeError for a proxy that is not installed, and CpuGroupError.
    """
    installed = installed_proxies()
    for name in names:
        if name in PROXIES and name not in installed:
            raise RuntimeError(f"{name} is not installed (on Debian: apt install {name})")
    with precedence():
        yield from _measure(names or ("stream", "redis", *installed), frames, folder, seconds)


def _measure(names: Sequence[str], frames: Path, folder: Path, seconds: float) -> Iterator[tuple[str, dict[str, Any]]]:
    images = [path.read_bytes() for path in sorted(frames.glob("*.jpg"))]
    for name in names:
        if name == "stream":
            yield name, asdict(measure_stream_needs(frames, folder))
        elif name == "redis":
            yield name, asdict(measure_redis(images, folder, _SESSIONS, seconds))
        else:
            sizes = len(images[0]), _ANSWER_BYTES
            for tls in (False, True):
                figures = measure_proxy(name, tls=tls, sizes=sizes, seconds=seconds, folder=folder)
                yield f"{name} with TLS" if tls else name, asdict(figures)
