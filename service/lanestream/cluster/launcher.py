"""`lanestream cluster up`: deploys the service on a Ray cluster, a local one by default, and removes it at the end."""

from __future__ import annotations

import ipaddress
import logging
import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TYPE_CHECKING, Any, Final

from lanestream.api.app import create_app
from lanestream.api.auth import warn_if_open
from lanestream.api.server import listen
from lanestream.errors import LanestreamError, SettingsError, needs_extra, one_line
from lanestream.host import processors
from lanestream.logs import flush_logs, log_beside_others

with needs_extra("cluster,cpu"):
    import ray
    from ray import serve
    from ray.exceptions import RayError
    from ray.serve.exceptions import RayServeException

    from lanestream.cluster.deployment import application

if TYPE_CHECKING:
    from lanestream.cluster.options import ClusterOptions
    from lanestream.settings import Settings

_log = logging.getLogger(__name__)
_APPLICATION: Final = "lanestream"
_LOGS: Final = "the logs of the replicas are in /tmp/ray/session_latest/logs"
_CONNECT_S: Final = 10.0
_POLL_S: Final = 2.0
# What shells add to the number of the signal by which a process ended.
_SIGNALED: Final = 128


def up(settings: Settings, options: ClusterOptions, address: str | None) -> None:
    """Serves on the Ray cluster at `address`, or on a local one that it starts, until a signal stops the process.

    Then it drains the replicas, and stops what it started. Raises SettingsError if the settings can't be used or the
    cluster can't be reached, and LanestreamError if the replicas can't start.
    """
    # Finds what is wrong before Ray starts.
    authenticator = create_app(None, settings).state.service.authenticator
    log_beside_others(settings)
    if address is None:
        settings = _check_machine(settings, options)
    with _stop_signals() as stop:
        try:
            _connect(address)
            warn_if_open(authenticator, settings.host, loopback=_is_loopback(settings.host))
            with _deployed(settings, options, local=address is None):
                stop.began()
                _follow(stop)
        except KeyboardInterrupt:
            _log.info("stopped before it was ready")
        finally:
            ray.shutdown()
            flush_logs()


class _Stop:
    """The signal to stop. While the replicas start, it interrupts the main thread; a second one ends the process."""

    def __init__(self) -> None:
        self.requested = threading.Event()
        self.number: int | None = None
        self._starting = True

    def began(self) -> None:
        """Notes that the replicas have started."""
        self._starting = False

    def __call__(self, number: int, _: FrameType | None) -> None:
        if self.requested.is_set():
            flush_logs()
            os._exit(_SIGNALED + number)
        self.number = number
        self.requested.set()
        if self._starting:
            raise KeyboardInterrupt


@contextmanager
def _stop_signals() -> Iterator[_Stop]:
    stop = _Stop()
    handled = [signal.SIGINT, signal.SIGTERM]
    # A terminal that is closed sends it. A process that was started to ignore it, by nohup, goes on.
    handled += [signal.SIGHUP] if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN else []
    before = {number: signal.signal(number, stop) for number in handled}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if stop.number not in (None, signal.SIGINT):
        # The parent process sees why this one ended.
        signal.raise_signal(stop.number)


def _check_machine(settings: Settings, options: ClusterOptions) -> Settings:
    """Returns the settings with a port that is free. Raises SettingsError if this machine can't run the replicas."""
    needed, available = options.max_replicas * options.cpus, processors()
    if needed > available:
        raise SettingsError(
            f"the replicas need {needed:g} processors, and this machine has {available}",
            "use fewer --replicas, or smaller ones with --cpus",
        )
    with listen(settings.host, settings.port) as listener:
        return settings.model_copy(update={"port": listener.getsockname()[1]})


def _connect(address: str | None) -> None:
    """Connects to a cluster, or starts a local one. Raises SettingsError if it can't be reached."""
    _log.info(
        "starting Ray" if address is None else "connecting to the Ray cluster at %s", *([address] if address else [])
    )
    local: dict[str, Any] = {"num_cpus": processors(), "include_dashboard": False} if address is None else {}
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        if address is not None:
            _check_reachable(address)
        ray.init(address or "local", logging_level=logging.ERROR, **local)
    except (OSError, OverflowError, RayError, RuntimeError, ValueError) as error:
        where = f"can't use the Ray cluster at {address}" if address else "can't start Ray"
        raise SettingsError(
            f"{where}: {one_line(error)}", "give the address that `ray start` printed" if address else ""
        ) from None
    for number, handler in handlers.items():  # Ray sets handlers of its own
        signal.signal(number, handler)
    logging.getLogger("ray.serve").setLevel(logging.ERROR)


def _check_reachable(address: str) -> None:
    """Raises OSError if nothing listens at an address with a port, for which Ray itself would wait for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_S).close()


@contextmanager
def _deployed(settings: Settings, options: ClusterOptions, *, local: bool) -> Iterator[None]:
    """Runs the application during the block. Raises LanestreamError if it can't start."""
    status = _status()
    if status is not None and _APPLICATION in status.applications:
        raise SettingsError("Lanestream already runs on this cluster", "stop it there, or use another cluster")
    quiet = {"log_level": "WARNING", "enable_access_log": False}
    try:
        if status is None:
            http = {"host": settings.host, "port": settings.port}
            serve.start(proxy_location="EveryNode", http_options=http, logging_config=quiet)
        _log.info("starting replicas, at first %d, and loading the networks", options.min_replicas)
        serve.run(application(settings, options), name=_APPLICATION, route_prefix="/", logging_config=quiet)
        for url in _urls(settings, started=status is None):
            _log.info("ready at %s", url, extra={"event": "ready", "url": url})
        yield
    except (RayError, RuntimeError, TimeoutError, ValueError) as error:
        raise _start_failure(error) from None
    finally:
        _log.info("draining the replicas")
        with suppress(RayError, RayServeException):
            serve.delete(_APPLICATION)
        if status is None and not local:
            serve.shutdown()


def _status() -> Any | None:
    """Returns the status of Serve; None if it does not run on the cluster."""
    status = serve.status()
    return status if status.proxies or status.applications else None


def _urls(settings: Settings, *, started: bool) -> list[str]:
    """Returns the URLs of the proxies, as far as they can be reached from here."""
    if not started:
        return ["the proxies of this cluster's Ray Serve"]
    if _is_loopback(settings.host):
        return [_url(settings.host, settings.port)]
    running = set(serve.status().proxies)
    return [_url(node["NodeManagerAddress"], settings.port) for node in ray.nodes() if node["NodeID"] in running]


def _url(host: str, port: int) -> str:
    return f"http://{f'[{host}]' if ':' in host else host}:{port}"


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _start_failure(error: Exception) -> LanestreamError:
    """Returns why the replicas can't start: the last line of the traceback that Serve has of one of them."""
    with suppress(RayError, RayServeException):
        return _failure(error, serve.status().applications.get(_APPLICATION))
    return _failure(error, None)


def _failure(error: Exception, application: Any) -> LanestreamError:
    messages = [] if application is None else [each.message for each in application.deployments.values()]
    lines = [line.strip() for line in "\n".join([str(error), *messages]).splitlines() if line.strip()]
    found = [line.partition(": ")[2] for line in lines if line.startswith("lanestream.errors.")]
    reason = one_line((found or lines)[-1], 400)
    return LanestreamError(f"the replicas can't start: {reason}", "" if found else _LOGS)


def _follow(stop: _Stop) -> None:
    """Waits for a signal. Raises LanestreamError if the cluster is gone."""
    while not stop.requested.wait(_POLL_S):
        try:
            serve.status()
        except (RayError, ConnectionError, RuntimeError) as error:
            raise LanestreamError(f"the cluster is gone: {one_line(error)}") from None
