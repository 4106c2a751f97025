"""The command `lanestream`. Sub-commands live with what they drive and are imported only when they are called."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from typing import Any, Final, Literal

import click

from lanestream import __version__
from lanestream.errors import LanestreamError, needs_extra

# Command: (module, attribute, the extra it needs, its help in one line).
_COMMANDS: Final[dict[str, tuple[str, str, str, str]]] = {
    "detect": ("lanestream_client.commands", "detect", "service,cpu", "Find the lanes of single images."),
    "evaluate": ("lanestream_exporter.network_commands", "evaluate", "export,service,cpu", "Measure a model file."),
    "export": ("lanestream_exporter.network_commands", "export", "export,service,cpu", "Write a checkpoint as ONNX."),
    "scene": ("lanestream_exporter.scene_commands", "scene", "video", "Render a clip with its labels."),
    "stream": ("lanestream_client.commands", "stream", "video", "Track the lanes of a video or a camera."),
    "train": ("lanestream_exporter.network_commands", "train", "train,service,cpu", "Train a network."),
}


class LazyGroup(click.Group):
    """A group whose help needs none of its commands: an extra that is missing hides nothing."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """All commands, whether or not their packages are installed."""
        return sorted([*super().list_commands(ctx), *_COMMANDS])

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Imports the command. Raises MissingExtraError where its packages are not installed."""
        if cmd_name not in _COMMANDS:
            return super().get_command(ctx, cmd_name)
        module, attribute, extra, _ = _COMMANDS[cmd_name]
        with needs_extra(extra):
            command = getattr(importlib.import_module(module), attribute)
        assert isinstance(command, click.Command)  # noqa: S101 - the table above names commands only
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes the commands with their one line of help."""
        known = {name: entry[3] for name, entry in _COMMANDS.items()}
        for name in super().list_commands(ctx):
            command = super().get_command(ctx, name)
            known[name] = command.get_short_help_str(80) if command is not None else ""
        with formatter.section("Commands"):
            formatter.write_dl(sorted(known.items()))


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="lanestream")
@click.pass_context
def cli(context: click.Context) -> None:
    """Camera frames in, tracked lane lines out."""
    context.obj = _load_local


@cli.command()
@click.option("--host", help="Address to listen on. [default: 127.0.0.1]")
@click.option("--port", type=int, help="Port to listen on; 0 takes a free one. [default: 8000]")
@click.option("--model", type=click.Path(path_type=Path), help="ONNX file to serve. [default: the shipped one]")
@click.option("--provider", type=click.Choice(["auto", "cpu", "cuda"]), help="Where it runs. [default: auto]")
@click.option("--max-sessions", type=int, help="Streams at a time at most. [default: 64]")
def serve(**given: Any) -> None:
    """Serve lanes over HTTP and WebSocket; every option is also a variable LANESTREAM_<NAME>."""
    with needs_extra("service,cpu"):
        from lanestream.api.server import serve as run
        from lanestream.engine import load_engine
        from lanestream.settings import load_settings
    settings = load_settings(**given)
    run(settings, lambda: load_engine(settings.model, settings.provider), _drawing())


def _drawing() -> Any:
    """What draws lanes on pictures, where the client's overlays are installed; they come with this distribution."""
    try:
        return importlib.import_module("lanestream_client.overlays").draw_lanes
    except ImportError:
        return None


def _load_local(model: Path | None, provider: Literal["auto", "cpu", "cuda"] | None) -> Any:
    """An engine in this process, for commands that were given no URL."""
    with needs_extra("service,cpu"):
        from lanestream.local import LocalEngine
    return LocalEngine.load(model, provider or "auto")


def main() -> None:
    """Runs the command line; an error is one line on stderr and the exit code 1."""
    try:
        sys.exit(cli(standalone_mode=False))
    except LanestreamError as error:
        _fail(f"error: {error}", 1)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        _fail("interrupted", 130)
    except BrokenPipeError:
        # Whoever read our output has gone; what is left in the buffer must not be flushed into nothing at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)


def _fail(line: str, code: int) -> None:
    click.echo(line, err=True)
    sys.exit(code)
