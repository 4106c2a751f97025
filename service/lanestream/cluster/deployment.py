"""The application that Ray Serve runs, made of the settings of the service and the options of the cluster."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from lanestream.api.overlay import installed_overlay
from lanestream.cluster.options import ClusterOptions, check_settings, replica_settings
from lanestream.cluster.replica import SETTLE_S, Replica
from lanestream.engine import load_engine, resolve_regressor
from lanestream.errors import needs_extra
from lanestream.settings import load_settings

with needs_extra("cluster"):
    from ray import serve

if TYPE_CHECKING:
    from lanestream.engine import Engine
    from lanestream.settings import Settings

# How often Serve checks a replica. A machine that is lost is noticed earlier where its connections break.
_HEALTH_CHECK_S: Final = 2.0
_HEALTH_TIMEOUT_S: Final = 10.0
_DRAIN_POLL_S: Final = 0.5
# What a replica may take to stop beyond the time limit of its drain.
_STOP_S: Final = 5.0
# Requests of a replica besides its streams: single images and probes.
_OTHER_REQUESTS: Final = 64
# Over this time the number of open streams is averaged.
_LOOK_BACK_S: Final = 10.0


def application(settings: Settings, options: ClusterOptions, load: Callable[[], Engine] | None = None) -> Any:
    """Returns the application for `serve.run`. Its replicas get these settings, whatever their own environment has.

    `load` returns a warm engine; by default it loads the networks of the settings. Raises SettingsError if the settings
    can't be used on a cluster.
    """
    check_settings(settings, options)
    settings = replica_settings(settings, options)
    deployment = serve.deployment(
        serve.ingress()(Replica),
        name="Lanestream",
        ray_actor_options={"num_cpus": options.cpus, "num_gpus": options.gpus},
        max_ongoing_requests=settings.max_sessions + _OTHER_REQUESTS,
        health_check_period_s=_HEALTH_CHECK_S,
        health_check_timeout_s=_HEALTH_TIMEOUT_S,
        graceful_shutdown_wait_loop_s=_DRAIN_POLL_S,
        graceful_shutdown_timeout_s=SETTLE_S + settings.drain_s + _STOP_S,
        **_replicas(options),
    )
    # Ray stores arguments as a pickle. Its dashboard shows a deployment's options and environment variables.
    return deployment.bind(settings, load or partial(_load_engine, settings), installed_overlay())


def from_config(arguments: dict[str, object]) -> Any:
    """Returns the application for a configuration file of Serve, which names this function as its `import_path`.

    `arguments` are the `args` in that file, see ClusterOptions. The settings come from the environment. Raises
    SettingsError.
    """
    return application(load_settings(), ClusterOptions.parse(arguments))


def _replicas(options: ClusterOptions) -> dict[str, Any]:
    if options.min_replicas == options.max_replicas:
        return {"num_replicas": options.min_replicas}
    return {
        "autoscaling_config": {
            "min_replicas": options.min_replicas,
            "max_replicas": options.max_replicas,
            # A stream is one ongoing request for as long as its socket is open.
            "target_ongoing_requests": options.sessions_per_replica,
            "upscale_delay_s": options.upscale_delay_s,
            "downscale_delay_s": options.downscale_delay_s,
            "look_back_period_s": _LOOK_BACK_S,
        }
    }


def _load_engine(settings: Settings) -> Engine:
    """Returns the engine of these settings; runs where its files must be."""
    regressor = resolve_regressor(settings.regressor)
    return load_engine(settings.model, settings.provider, regressor, settings.runtime_options)
