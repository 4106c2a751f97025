"""A replica on Ray Serve: the service's application, and what its own server does for it elsewhere.

Serve waits until the requests of a replica have ended before it stops it, and gives the application no notice. A stream
is a request that does not end by itself. So the replica watches the list of replicas that Serve's routers use: if it is
no longer in that list, it drains its streams. If the list has grown, it hands over a share of its streams to the new
replicas, because otherwise a stream stays where it was opened.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Collection
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from lanestream.api.app import create_app
from lanestream.api.server import start_pool, start_upkeep, tune_process, watched_keys
from lanestream.cluster.metrics import RayMetrics
from lanestream.errors import needs_extra
from lanestream.logs import log_beside_others

with needs_extra("cluster"):
    import ray
    from ray import serve
    from ray.exceptions import RayError

    # Serve has no public interface for these.
    from ray.serve._private.common import DeploymentID
    from ray.serve._private.constants import (
        RAY_SERVE_ENABLE_DIRECT_INGRESS,
        SERVE_CONTROLLER_NAME,
        SERVE_NAMESPACE,
    )
    from ray.serve._private.long_poll import LongPollNamespace, LongPollState

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from lanestream.api.service import DrawLanes, Service
    from lanestream.engine import Engine
    from lanestream.settings import Settings

_log = logging.getLogger(__name__)

_METRICS_S: Final = 5.0
# How long requests still come that a router sent before it learned that this replica is being stopped.
SETTLE_S: Final = 1.0
_RETRY_S: Final = 1.0
# The states of a replica and of an application, as Serve's controller shows them.
_STOPPING: Final = "STOPPING"
_DELETING: Final = "DELETING"


class Replica:
    """The user class of the deployment; Serve calls its methods in one event loop.

    `load` returns a warm engine, in worker processes that must be able to import it.
    """

    def __init__(self, settings: Settings, load: Callable[[], Engine], draw: DrawLanes | None) -> None:
        log_beside_others(settings)
        self._settings, self._load, self._draw = settings, load, draw
        self._service: Service | None = None
        self._tasks: list[asyncio.Task[None]] = []

    async def __serve_build_asgi_app__(self) -> ASGIApp:
        """Returns the application with a warm worker pool. Raises any error of `load`."""
        if RAY_SERVE_ENABLE_DIRECT_INGRESS:
            _log.warning(
                "Ray Serve runs with HAProxy or direct ingress, which may end streams whenever replicas come or go:"
                " set RAY_SERVE_ENABLE_HA_PROXY=0 and RAY_SERVE_ENABLE_DIRECT_INGRESS=0 on all nodes"
            )
        tune_process(self._settings)
        app = create_app(None, self._settings, self._draw)
        service: Service = app.state.service
        service.install(await start_pool(service, self._load))
        self._service = service
        self._tasks = [
            *start_upkeep(watched_keys(service), lambda: False),
            asyncio.create_task(_watch_replicas(service)),
            asyncio.create_task(_export_metrics(service)),
        ]
        _log.info("ready", extra={"event": "ready"})
        return PeerLoss(app)

    async def check_health(self) -> None:
        """Raises NotReadyError if the replica cannot replace its worker processes any more: Serve then replaces it."""
        if self._service is not None:
            self._service.check_alive()


class PeerLoss:
    """Makes the loss of Ray's proxy, whose machine may be gone, look like that of the client behind it."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Runs the application."""

        async def receive_from_proxy() -> Message:
            try:
                return await receive()
            except RayError:
                if scope["type"] == "websocket":
                    return {"type": "websocket.disconnect", "code": 1006, "reason": ""}
                return {"type": "http.disconnect"}

        await self._app(scope, receive_from_proxy, send)


class StreamMover:
    """Moves streams away from this replica, named `own`, when the list of running replicas changes.

    A replica that is not in the list is being stopped, or Serve's controller has restarted and has not found it again
    yet. `is_stopping` asks the controller which of the two it is.
    """

    def __init__(self, service: Service, own: str, is_stopping: Callable[[], Awaitable[bool]]) -> None:
        self._service = service
        self._own = own
        self._is_stopping = is_stopping
        # Names are never used again.
        self._seen: frozenset[str] = frozenset()
        self._drain: asyncio.Task[None] | None = None

    def update(self, running: Collection[str]) -> None:
        """Hands over streams to new replicas, and drains the service if this replica is being stopped."""
        new = frozenset(running) - self._seen
        started = self._own in self._seen
        self._seen |= new
        if self._own not in running:
            if started and self._drain is None:
                self._drain = asyncio.create_task(self._drain_if_stopping())
            return
        if self._drain is not None:
            self._drain.cancel()
            self._drain = None
        moved = self._service.hand_over(len(self._service.streams) * len(new) // len(running)) if started else 0
        if moved:
            _log.info(
                "%d streams move to new replicas", moved, extra={"event": "streams_handed_over", "streams": moved}
            )

    async def _drain_if_stopping(self) -> None:
        while not await self._is_stopping():
            await asyncio.sleep(_RETRY_S)
        _log.info("this replica is being stopped", extra={"event": "replica_stopping"})
        await asyncio.sleep(SETTLE_S)
        await self._service.drain()


async def _watch_replicas(service: Service) -> None:
    """Drains the service once Serve stops this replica, and hands over streams when it adds others."""
    context = serve.get_replica_context()
    key = (LongPollNamespace.DEPLOYMENT_TARGETS, DeploymentID(name=context.deployment, app_name=context.app_name))
    mover = StreamMover(service, context.replica_tag, partial(_is_stopping, context))
    snapshots = {key: -1}
    while True:
        try:
            updates = await _controller().listen_for_change.remote(snapshots)
        except (RayError, ValueError):  # the controller is being restarted
            await asyncio.sleep(_RETRY_S)
            continue
        if updates == LongPollState.TIME_OUT:
            continue
        for update in updates.values():
            snapshots[key] = update.snapshot_id
            mover.update([info.replica_id.unique_id for info in update.object_snapshot.running_replicas])


async def _is_stopping(context: Any) -> bool:
    """Returns whether Serve's controller is stopping the replica of this context; False if it does not answer."""
    try:
        details = await _controller().get_serve_instance_details.remote()
    except (RayError, ValueError):
        return False
    application = details["applications"].get(context.app_name)
    if application is None:  # the controller has just restarted
        return False
    if application["status"] == _DELETING:
        return True
    replicas = application["deployments"].get(context.deployment, {}).get("replicas", [])
    return any(each["replica_id"] == context.replica_tag and each["state"] == _STOPPING for each in replicas)


def _controller() -> Any:
    return ray.get_actor(SERVE_CONTROLLER_NAME, namespace=SERVE_NAMESPACE)


async def _export_metrics(service: Service) -> None:
    metrics = RayMetrics()
    while True:
        service.sample_metrics()
        metrics.export(service.metrics.collect())
        await asyncio.sleep(_METRICS_S)
