"""The environment variables of Ray that the service depends on."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Final

# For all machines of a cluster: Ray's processes read them when they start.
RAY_VARIABLES: Final[Mapping[str, str]] = {
    # With HAProxy, streams may be ended whenever replicas come or go (Ray's issue 66056).
    "RAY_SERVE_ENABLE_HA_PROXY": "0",
    # Otherwise a proxy fills the replicas of its own machine before it uses those of others.
    "RAY_SERVE_PROXY_PREFER_LOCAL_NODE_ROUTING": "0",
    # Ray waits for three failed checks before it believes that a machine is lost: by default that takes 12 seconds or
    # more, and streams wait for it.
    "RAY_health_check_period_ms": "300",
    "RAY_health_check_timeout_ms": "1000",
    "RAY_health_check_failure_threshold": "3",
    # Serve's own log goes to its files only.
    "RAY_SERVE_LOG_TO_STDERR": "0",
    # Replicas start worker processes, of which gRPC needs to know nothing.
    "GRPC_ENABLE_FORK_SUPPORT": "0",
    # Ray sends no statistics over the internet.
    "RAY_USAGE_STATS_ENABLED": "0",
}
# For the process that follows the logs: it shows repeated records, too.
_DRIVER_VARIABLES: Final[Mapping[str, str]] = {"RAY_DEDUP_LOGS": "0"}


def set_ray_variables() -> None:
    """Sets the variables that are not set, here and for what is started here. Call it before Ray is imported."""
    for name, value in {**RAY_VARIABLES, **_DRIVER_VARIABLES}.items():
        os.environ.setdefault(name, value)
