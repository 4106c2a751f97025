"""The image's health check: exits with 0 if the service in the same container is ready for frames, else says why not.

It runs every few seconds, so it imports only the standard library.
"""

import os
import ssl
import sys
from collections.abc import Mapping
from http.client import HTTPException
from urllib.error import HTTPError
from urllib.request import HTTPSHandler, ProxyHandler, build_opener

TIMEOUT_S = 4.0
# The service may listen on all addresses; the check connects to the loopback address.
LOOPBACK = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104


def readiness_url(environment: Mapping[str, str]) -> str:
    """Returns the readiness URL of a service with the settings in `environment`."""
    host = environment.get("LANESTREAM_HOST") or "127.0.0.1"
    host = LOOPBACK.get(host, host)
    scheme = "https" if environment.get("LANESTREAM_TLS_CERTIFICATE") else "http"
    return f"{scheme}://{f'[{host}]' if ':' in host else host}:{environment.get('LANESTREAM_PORT') or '8000'}/readyz"


def problem(url: str) -> str | None:
    """Returns why the service at `url` is not ready, or None if it is."""
    # The certificate is for the name that clients use, not for this address.
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        # The container may have a proxy setting, which is for other hosts only.
        with build_opener(ProxyHandler({}), HTTPSHandler(context=context)).open(url, timeout=TIMEOUT_S):
            return None
    except HTTPError as error:
        with error:
            return f"{url}: {error.code} {error.read(500).decode(errors='replace')}"
    except (OSError, HTTPException) as error:
        return f"{url}: {error}"


if __name__ == "__main__":
    sys.exit(problem(readiness_url(os.environ)))
