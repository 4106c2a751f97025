"""The command `lanestream`: serves, and mounts the commands of the client and of the exporter when they are called."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from lanestream import __version__
from lanestream.errors import LanestreamError, needs_extra
from lanestream.keys import new_key
from lanestream.runtime import PROVIDERS

if TYPE_CHECKING:
    from lanestream.local import LocalEngine
    from lanestream.runtime import Provider

_FAILED: Final = 1
_INTERRUPTED: Final = 130
_TERMINATED: Final = 143
_FIRST_PROCESS: Final = 1


@dataclass(frozen=True)
class Mount:
    """A command of another package: where it is, the extra that its imports need, its line in the help."""

    module: str
    name: str
    extra: str
    help: str


_CLIENT: Final = "lanestream_client.commands"
_DATA: Final = "lanestream_exporter.data_commands"
_SCENES: Final = "lanestream_exporter.scene_commands"
_TRAINING: Final = "lanestream_exporter.training_commands"
_EXPORT: Final = "lanestream_exporter.export_commands"
_EVALUATION: Final = "lanestream_exporter.evaluation_commands"
_MOUNTS: Final[Mapping[str, Mount]] = {
    "detect": Mount(_CLIENT, "detect", "video", "Find lanes in images."),
    "stream": Mount(_CLIENT, "stream", "video", "Follow the lanes of one camera."),
    "doctor": Mount("lanestream.doctor", "doctor", "service,cpu", "Tell what networks run on here."),
    "scene": Mount(_SCENES, "scene", "video", "Render a clip of a road, with exact labels."),
    "data": Mount(_DATA, "data", "export", "Look after labelled frames."),
    "train": Mount(_TRAINING, "train", "train,service,cpu", "Train a network."),
    "export": Mount(_EXPORT, "export", "export,service,cpu", "Turn a checkpoint into a model file."),
    "evaluate": Mount(_EVALUATION, "evaluate", "export,service,cpu", "Measure a model's accuracy."),
    "score": Mount(_EVALUATION, "score", "export,service,cpu", "Measure a stream's results against labels."),
}


class MountingGroup(click.Group):
    """A group that imports a mounted command only when it is called, so that help needs no extra."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """All names, own and mounted."""
        return sorted({*super().list_commands(ctx), *_MOUNTS})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of that name. Raises MissingExtraError where its packages are not installed."""
        mount = _MOUNTS.get(cmd_name)
        if mount is None:
            return super().get_command(ctx, cmd_name)
        with needs_extra(mount.extra):
            command: click.Command = getattr(import_module(mount.module), mount.name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Lists the commands, the mounted ones by what is known here."""
        lines = []
        for name in self.list_commands(ctx):
            own = None if name in _MOUNTS else super().get_command(ctx, name)
            lines.append((name, own.get_short_help_str(90) if own else _MOUNTS[name].help))
        with formatter.section("Commands"):
            formatter.write_dl(lines)


@click.group(cls=MountingGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, message="lanestream %(version)s")
@click.pass_context
def cli(context: click.Context) -> None:
    """Camera frames in, tracked lane lines out."""
    context.obj = _load_local


@cli.command()
@click.option("--config", type=click.Path(path_type=Path), help="TOML file with settings.")
@click.option("--host", help="Address to listen on  [default: 127.0.0.1]")
@click.option("--port", type=click.IntRange(0, 65535), help="Port to listen on, 0 for a free one  [default: 8000]")
@click.option("--model", type=click.Path(path_type=Path), help="ONNX file of the network  [default: the shipped one]")
@click.option(
    "--regressor",
    type=click.Path(path_type=Path),
    metavar="FILE|none",
    help="ONNX file of the second network, or none  [default: the shipped one]",
)
@click.option("--provider", type=click.Choice(PROVIDERS), help="Where the networks run  [default: auto]")
@click.option("--max-sessions", type=click.IntRange(1), help="Streams at a time at most  [default: 64]")
@click.option("--api-keys-file", type=click.Path(path_type=Path), help="File of API keys, one NAME:SHA256 a line.")
@click.option("--log-format", type=click.Choice(["text", "json"]), help="Form of the log  [default: text]")
@click.option("--log-level", type=click.Choice(["debug", "info", "warning", "error"]), help="[default: info]")
@click.option("--print-config", is_flag=True, help="Print all settings, secrets masked, and end.")
def serve(*, print_config: bool, **given: Any) -> None:
    """Serve lanes over HTTP and WebSockets.

    Everything can also be set by LANESTREAM_<NAME>, or in the file of --config; --print-config prints all there is.
    """
    with needs_extra("service,cpu"):
        # The image module comes first, because OpenCV reads its limit once.
        from lanestream.api.server import serve as run
        from lanestream.engine import load_engine, resolve_regressor
        from lanestream.settings import load_settings, to_toml
        from lanestream_client.overlays import draw_lanes
    settings = load_settings(**given)
    if print_config:
        click.echo(to_toml(settings))
        return
    regressor = resolve_regressor(settings.regressor)
    load = partial(load_engine, settings.model, settings.provider, regressor, settings.runtime_options)
    run(settings, load, draw_lanes)


@cli.command()
@click.argument("name")
def key(name: str) -> None:
    """Make an API key for the caller NAME.

    The service is told its hash alone: the key itself is printed once, and kept nowhere.
    """
    token, made = new_key(name)
    click.echo(f"key:      {token}")
    click.echo(f"setting:  {made}")
    click.echo("The caller gets the key. The setting goes to LANESTREAM_API_KEYS, or to the keys file.", err=True)


def main() -> None:
    """Runs the command line. Errors that are raised on purpose are told in one line."""
    # What OpenCV would warn of on the side is said by the errors; it reads this once, when it is first imported.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    if os.getpid() == _FIRST_PROCESS:
        signal.signal(signal.SIGTERM, _end)
    try:
        code = cli.main(standalone_mode=False)
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever read the output has had enough; the interpreter must not try to flush the rest.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = _FAILED
    except LanestreamError as error:
        click.echo(f"error: {error}", err=True)
        code = _FAILED
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except click.Abort:
        code = _INTERRUPTED
    sys.exit(code if isinstance(code, int) else 0)


def _end(*_: object) -> None:
    """Does what SIGTERM does by itself, except to the first process of a container: that one would be deaf to it.

    While it serves, uvicorn's handler stands in the place of this one.
    """
    os._exit(_TERMINATED)


def _load_local(model: Path | None, provider: Provider, regressor: Path | None) -> LocalEngine:
    with needs_extra("service,cpu"):
        from lanestream.local import LocalEngine
    return LocalEngine.load(model, provider, regressor)


if __name__ == "__main__":
    main()
