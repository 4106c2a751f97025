"""The image's health check: ends with 0 where the service beside it is ready for frames, else says why not.

It runs every few seconds, so it needs the standard library alone.
"""

import os
import sys
from collections.abc import Mapping
from http.client import HTTPException
from urllib.error import HTTPError
from urllib.request import ProxyHandler, build_opener

TIMEOUT_S = 4.0
# An address that stands for all of them is listened on, not called.
LOOPBACK = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104


def readiness_url(environment: Mapping[str, str]) -> str:
    """Where a service with the settings of this `environment` tells whether it is ready."""
    host = environment.get("LANESTREAM_HOST") or "127.0.0.1"
    host = LOOPBACK.get(host, host)
    return f"http://{f'[{host}]' if ':' in host else host}:{environment.get('LANESTREAM_PORT') or '8000'}/readyz"


def problem(url: str) -> str | None:
    """Why the service at `url` is not ready; None where it is."""
    try:
        # A proxy that the container may be given is for the outside.
        with build_opener(ProxyHandler({})).open(url, timeout=TIMEOUT_S):
            return None
    except HTTPError as error:
        with error:
            return f"{url}: {error.code} {error.read(500).decode(errors='replace')}"
    except (OSError, HTTPException) as error:
        return f"{url}: {error}"


if __name__ == "__main__":
    sys.exit(problem(readiness_url(os.environ)))
