"""Options that several commands share, and what the program that mounts the commands passes to them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, get_args

import click

from lanestream.protocol import (
    HIGHEST_HORIZON,
    BoundaryKind,
    CameraModel,
    DetectorName,
    parse_camera,
    read_camera_file,
)

if TYPE_CHECKING:
    from lanestream_client.in_process import InProcessEngine

Command = Callable[..., None]


class LoadEngine(Protocol):
    """Loads an engine of this process. It is the object of the commands' context, and can be pickled."""

    def __call__(
        self, model: Path | None, provider: str | None, regressor: Path | None, threads: int | None = None
    ) -> InProcessEngine:
        """Returns an engine from the model file, the name of the execution provider and the regressor file.

        Each may be None for the default. `threads` is the number of CPU threads of one run of a network; None: one for
        each processor. Raises ModelError, ProviderError, and click.BadParameter if the provider is unknown.
        """
        ...

    def most_processes(self) -> int:
        """Returns how many processes with one thread each this machine has processors and memory for."""
        ...


def network_options(command: Command) -> Command:
    """Adds the options that choose the networks of this process and where they run."""
    return _with_options(
        command,
        click.option(
            "--model",
            type=click.Path(path_type=Path),
            metavar="FILE|shipped",
            help="ONNX file of the network to run in process  [default: shipped]",
        ),
        click.option(
            "--regressor",
            type=click.Path(path_type=Path),
            metavar="FILE|shipped|none",
            help="ONNX file of the regressor to run in process  [default: shipped]",
        ),
        click.option(
            "--provider",
            metavar="NAME",
            help="Execution provider in process; see `lanestream doctor --help`  [default: auto]",
        ),
    )


def detection_options(command: Command) -> Command:
    """Adds the options that say how lanes are found and which are reported."""
    return _with_options(
        command,
        click.option(
            "--detector",
            type=click.Choice(get_args(DetectorName)),
            help="Detector to use  [default: the model's]",
        ),
        click.option(
            "--horizon",
            type=click.FloatRange(HIGHEST_HORIZON, 1.0, max_open=True),
            help="Row of the horizon as a share of the image height, negative above the image  [default: estimated]",
        ),
        click.option(
            "--camera",
            "camera_file",
            type=click.Path(path_type=Path),
            metavar="FILE",
            help="Camera file, such as `lanestream calibrate` writes; lanes are also given in meters.",
        ),
        click.option(
            "--camera-height",
            type=click.FloatRange(0.3, 4.0),
            metavar="M",
            help="Height of the camera in meters; with --field-of-view, lanes are also given in meters.",
        ),
        click.option(
            "--field-of-view",
            type=click.FloatRange(20.0, 150.0),
            metavar="DEG",
            help="Horizontal field of view of the camera in degrees.",
        ),
        click.option(
            "--kinds",
            type=click.Choice(get_args(BoundaryKind)),
            multiple=True,
            help="Kind of boundaries to report; repeat it for several  [default: the service's, or all]",
        ),
    )


def chosen_camera(file: Path | None, height: float | None, field_of_view: float | None) -> CameraModel | None:
    """Returns the camera that the options describe. Raises UsageError and ProtocolError."""
    if file is None:
        return parse_camera(height, field_of_view)
    if height is not None or field_of_view is not None:
        raise click.UsageError("--camera can't be used with --camera-height and --field-of-view: the file has both")
    return read_camera_file(file)


def _with_options(command: Command, *options: Callable[[Any], Any]) -> Command:
    for option in reversed(options):
        command = option(command)
    return command
