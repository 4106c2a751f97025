"""The command `lanestream`: runs the service, and mounts the commands of the client and of the exporter.

The service must not import the packages above it. They announce their commands by entry points in pyproject.toml.
"""

from __future__ import annotations

import os
import signal
import sys
import webbrowser
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import import_module
from importlib.metadata import entry_points
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from lanestream import __version__
from lanestream.errors import CameraLostError, LanestreamError, missing_extra, needs_extra, needs_whole_packages
from lanestream.host import memory, processors
from lanestream.inference.providers import AUTO, PROVIDER_NAMES
from lanestream.keys import new_key

if TYPE_CHECKING:
    from lanestream.local import LocalEngine

# Exit codes; the last two are 128 plus the number of the signal, as shells report it.
_EXIT_FAILED: Final = 1
_EXIT_CAMERA_LOST: Final = 3
_EXIT_INTERRUPTED: Final = 130
_EXIT_TERMINATED: Final = 143

# The memory that a process with an engine may need for frames of any usual size.
_ENGINE_BYTES: Final = 600e6
# The extra that the commands of this package need when they run.
_SERVICE_EXTRA: Final = "service,cpu"
_CLUSTER_EXTRA: Final = "cluster,cpu"

# Each entry point of this group is a mapping from a command's name to the fields of a MountedCommand.
_COMMANDS_GROUP: Final = "lanestream.commands"


@dataclass(frozen=True)
class MountedCommand:
    """A command that is imported when it is called: its `target` is "module:function".

    `extra` names the optional packages that it needs when it runs, as in `pip install 'lanestream[EXTRA]'`. Its module
    imports none of them at the top, so that its help and its usage errors work without them.
    """

    target: str
    extra: str
    help: str

    def load(self) -> click.Command:
        """Imports the command."""
        module, _, name = self.target.partition(":")
        command: click.Command = getattr(import_module(module), name)
        return command


class LocalEngines:
    """Loads engines for the commands that work in this process; see LoadEngine in the client."""

    def __call__(
        self, model: Path | None, provider: str | None, regressor: Path | None, threads: int | None = None
    ) -> LocalEngine:
        """Returns a warm engine. Raises BadParameter, ModelError and ProviderError."""
        chosen = next((known for known in PROVIDER_NAMES if known == (provider or AUTO)), None)
        if chosen is None:
            raise click.BadParameter(
                f"{provider!r} is not one of {', '.join(PROVIDER_NAMES)}.",
                ctx=click.get_current_context(silent=True),
                param_hint="'--provider'",
            )
        with needs_extra(_SERVICE_EXTRA):
            from lanestream.local import LocalEngine

            return LocalEngine.load(model, chosen, regressor, threads)

    def most_processes(self) -> int:
        """Returns how many processes with an engine of one thread this machine has processors and memory for."""
        return max(1, min(processors(), int(memory() / _ENGINE_BYTES)))


class CommandGroup(click.Group):
    """A group that lists mounted commands without importing them, so that help needs no extra."""

    @cached_property
    def mounted(self) -> Mapping[str, MountedCommand]:
        """The mounted commands by name."""
        commands: dict[str, MountedCommand] = {}
        for entry_point in entry_points(group=_COMMANDS_GROUP):
            commands |= {name: MountedCommand(**fields) for name, fields in entry_point.load().items()}
        return commands

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Returns the names of all commands, own and mounted."""
        return sorted({*super().list_commands(ctx), *self.mounted})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Returns the command of that name, or None."""
        mounted = self.mounted.get(cmd_name)
        return super().get_command(ctx, cmd_name) if mounted is None else mounted.load()

    def invoke(self, ctx: click.Context) -> Any:
        """Runs the command. Raises MissingExtraError if it imports a package that is not installed."""
        try:
            return super().invoke(ctx)
        except ModuleNotFoundError as error:
            if (error.name or "").startswith("lanestream"):
                raise
            mounted = self.mounted.get(ctx.invoked_subcommand or "")
            raise missing_extra(error, _SERVICE_EXTRA if mounted is None else mounted.extra) from None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes the list of commands for the help."""
        lines = {name: mounted.help for name, mounted in self.mounted.items()}
        for name in super().list_commands(ctx):
            lines[name] = self.commands[name].get_short_help_str(90)
        with formatter.section("Commands"):
            formatter.write_dl(sorted(lines.items()))


_MODEL: Final = click.option(
    "--model",
    type=click.Path(path_type=Path),
    metavar="FILE|shipped",
    help="ONNX file of the network  [default: shipped]",
)
_REGRESSOR: Final = click.option(
    "--regressor",
    type=click.Path(path_type=Path),
    metavar="FILE|shipped|none",
    help="ONNX file of the regressor  [default: shipped]",
)


def _service_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the options for the most used settings of the service, in the order of this list."""
    options = (
        click.option("--config", type=click.Path(path_type=Path), help="TOML file with settings."),
        click.option("--host", help="Address to listen on  [default: 127.0.0.1]"),
        click.option(
            "--port", type=click.IntRange(0, 65535), help="Port to listen on, 0 for a free one  [default: 8000]"
        ),
        _MODEL,
        _REGRESSOR,
        click.option("--provider", type=click.Choice(PROVIDER_NAMES), help="Execution provider  [default: auto]"),
        click.option(
            "--max-sessions", type=click.IntRange(1), help="Maximum number of concurrent streams  [default: 64]"
        ),
        click.option(
            "--api-keys-file", type=click.Path(path_type=Path), help="File of API keys, one NAME:SHA256 per line."
        ),
        click.option("--log-format", type=click.Choice(["text", "json"]), help="Log format  [default: text]"),
        click.option(
            "--log-level", type=click.Choice(["debug", "info", "warning", "error"]), help="Log level  [default: info]"
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command


@click.group(cls=CommandGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, message="lanestream %(version)s")
@click.pass_context
def cli(context: click.Context) -> None:
    """Camera frames in, tracked lane lines out."""
    context.obj = LocalEngines()


@cli.command()
@_service_options
@click.option("--tls-certificate", type=click.Path(path_type=Path), help="PEM file of the certificate for https.")
@click.option("--tls-key", type=click.Path(path_type=Path), help="PEM file of its private key, if it is another file.")
@click.option("--open", "open_page", is_flag=True, help="Open the live page in a browser once the service is ready.")
@click.option("--print-config", is_flag=True, help="Print all settings with secrets masked, and exit.")
def serve(*, open_page: bool, print_config: bool, **options: Any) -> None:
    """Serve lanes over HTTP and WebSockets.

    Every setting can also be given as LANESTREAM_<NAME>, or in the file of --config. --print-config lists them all.
    """
    from lanestream.api.overlay import installed_overlay
    from lanestream.api.server import serve as run
    from lanestream.engine import load_engine, resolve_regressor
    from lanestream.settings import load_settings, to_toml

    # Last: OpenCV reads its pixel limit when it is first imported, and the service's modules set that limit before.
    draw_lanes = installed_overlay()
    settings = load_settings(**options)
    if print_config:
        click.echo(to_toml(settings))
        return
    if open_page and not settings.live_page:
        raise click.UsageError("--open needs the live page: set LANESTREAM_LIVE_PAGE to true")
    regressor = resolve_regressor(settings.regressor)
    load = partial(load_engine, settings.model, settings.provider, regressor, settings.runtime_options)
    run(settings, load, draw_lanes, _open_in_browser if open_page else None)


@cli.group()
def cluster() -> None:
    """Run the service on a Ray cluster."""


@cluster.command()
@click.option("--address", help="Ray cluster to use, such as 10.0.0.1:6379 or auto  [default: start one here]")
@click.option(
    "--replicas", metavar="N|MIN..MAX", default="1", show_default=True, help="Number of replicas, or its range."
)
@click.option(
    "--sessions-per-replica",
    type=click.IntRange(1),
    help="With more streams per replica than this, replicas are added  [default: 4]",
)
@click.option("--cpus", type=click.FloatRange(0.0, min_open=True), help="Processors of a replica  [default: 1]")
@click.option("--gpus", type=click.FloatRange(0.0), help="GPUs of a replica  [default: 0]")
@_service_options
def up(
    *,
    address: str | None,
    replicas: str,
    sessions_per_replica: int | None,
    cpus: float | None,
    gpus: float | None,
    **options: Any,
) -> None:
    """Serve on a Ray cluster until Ctrl-C.

    Every setting of `serve` can also be given as LANESTREAM_<NAME>, or in the file of --config. More than one replica
    needs LANESTREAM_REDIS_URL.
    """
    with needs_extra(_CLUSTER_EXTRA):
        from lanestream.cluster.options import ClusterOptions, check_settings, parse_replicas
        from lanestream.cluster.ray_variables import set_ray_variables
        from lanestream.settings import load_settings

    try:
        least, most = parse_replicas(replicas)
    except ValueError as error:
        raise click.BadParameter(f"{error}.", param_hint="'--replicas'") from None
    given = {"sessions_per_replica": sessions_per_replica, "cpus": cpus, "gpus": gpus}
    values = {name: value for name, value in given.items() if value is not None}
    cluster_options = ClusterOptions.parse({"min_replicas": least, "max_replicas": most, **values})
    settings = load_settings(**options)
    check_settings(settings, cluster_options)
    set_ray_variables()
    with needs_extra(_CLUSTER_EXTRA):
        # Takes seconds.
        from lanestream.cluster.launcher import up as run
    run(settings, cluster_options, address)


@cli.command()
@click.argument("name")
def key(name: str) -> None:
    """Create an API key for the caller NAME.

    The service needs only the hash of the key. The key itself is printed once and not stored.
    """
    token, setting = new_key(name)
    click.echo(f"key:      {token}")
    click.echo(f"setting:  {setting}")
    click.echo("Give the key to the caller. Add the setting to LANESTREAM_API_KEYS or to the keys file.", err=True)


@cli.command()
@click.option(
    "--require",
    "required",
    type=click.Choice(PROVIDER_NAMES[1:]),
    help="Fail unless all networks run on this provider.",
)
@click.option("--provider", type=click.Choice(PROVIDER_NAMES), help="The provider to run on  [default: auto]")
@_MODEL
@_REGRESSOR
@click.option("--config", type=click.Path(path_type=Path), help="TOML file of settings, as for `serve`.")
@click.option("--json", "as_json", is_flag=True, help="Write one JSON document.")
@click.pass_context
def doctor(context: click.Context, /, *, required: str | None, as_json: bool, **given: Any) -> None:
    """Report which execution providers work here, and how fast.

    The networks are loaded and timed with the same settings as for `serve`. Suggestions say what would be faster.
    """
    from lanestream.doctor import diagnose, print_diagnosis
    from lanestream.settings import load_settings

    diagnosis = diagnose(load_settings(**given), required)
    print_diagnosis(diagnosis, as_json=as_json)
    if diagnosis.problem is not None:
        click.echo(f"error: {diagnosis.problem}", err=True)
        context.exit(1)


@cli.command()
@click.argument("files", nargs=-1, type=click.Path(path_type=Path), metavar="[FILE]...")
@click.option("--json", "as_json", is_flag=True, help="Write one JSON document.")
def models(files: tuple[Path, ...], *, as_json: bool) -> None:
    """Describe model files, by default the shipped ones."""
    from lanestream.model_files import describe_models, print_models

    print_models(describe_models(files), as_json=as_json)


def main() -> None:
    """Runs the command line. Prints a LanestreamError in one line and exits."""
    # OpenCV's warnings only repeat what the errors say. It reads this variable once, when it is first imported.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    if isinstance(sys.stdout, TextIOWrapper):
        # What the terminal can't show, such as a file name in another encoding, is escaped, as on standard error.
        sys.stdout.reconfigure(errors="backslashreplace")
    if os.getpid() == 1:
        signal.signal(signal.SIGTERM, _terminate)
    try:
        with needs_whole_packages():
            code = cli.main(standalone_mode=False)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of the output has closed it; the interpreter must not try to flush the rest at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = _EXIT_FAILED
    except LanestreamError as error:
        click.echo(f"error: {error}", err=True)
        code = _EXIT_CAMERA_LOST if isinstance(error, CameraLostError) else _EXIT_FAILED
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except click.Abort:
        code = _EXIT_INTERRUPTED
    sys.exit(code if isinstance(code, int) else 0)


def _open_in_browser(url: str) -> None:
    if not webbrowser.open(url):
        click.echo(f"no browser was found: open {url} in one", err=True)


def _terminate(*_: object) -> None:
    """Ends the process on SIGTERM, which the kernel ignores by default for the first process of a container.

    While the service runs, uvicorn's handler replaces this one.
    """
    os._exit(_EXIT_TERMINATED)


if __name__ == "__main__":
    # Not this module under its other name, whose classes other processes can't import.
    import lanestream.cli

    lanestream.cli.main()
