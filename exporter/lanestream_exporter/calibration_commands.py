"""The command `calibrate`: writes a camera file from pictures of a chessboard or from a drive."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import click

from lanestream.errors import SourceError
from lanestream.protocol import CameraModel, parse_camera, read_camera_file


class BoardType(click.ParamType[tuple[int, int]]):
    """A click type for COLUMNSxROWS, the inner corners of a chessboard."""

    name = "COLUMNSxROWS"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Returns (columns, rows); fails with a message that says what is accepted."""
        try:
            columns, rows = (int(part) for part in str(value).lower().split("x"))
        except ValueError:
            self.fail(f"{value!r} is not a board; give its inner corners as COLUMNSxROWS, such as 9x6", param, ctx)
        if not (3 <= columns <= 50 and 3 <= rows <= 50):
            self.fail(f"{value!r} is not supported; give 3x3 to 50x50 inner corners", param, ctx)
        return columns, rows


@click.command()
@click.argument("source", type=click.Path(path_type=Path), metavar="FOLDER_OR_VIDEO")
@click.option("-o", "--out", type=click.Path(path_type=Path, dir_okay=False), required=True, help="Camera file.")
@click.option(
    "--height", type=click.FloatRange(0.3, 4.0), metavar="M", help="Height of the camera above the road in meters."
)
@click.option(
    "--board",
    type=BoardType(),
    default="9x6",
    show_default=True,
    help="Inner corners of the chessboard, where four of its squares meet.",
)
@click.option(
    "--camera",
    "camera_file",
    type=click.Path(path_type=Path),
    help="Camera file with the lens; then the pictures are of a drive.",
)
@click.option(
    "--field-of-view",
    type=click.FloatRange(20.0, 150.0),
    metavar="DEG",
    help="Horizontal field of view of the lens; then the pictures are of a drive.",
)
def calibrate(
    source: Path,
    out: Path,
    height: float | None,
    board: tuple[int, int],
    camera_file: Path | None,
    field_of_view: float | None,
) -> None:
    """Calibrate a camera and write a camera file.

    From pictures of a chessboard comes the lens: focal lengths, principal point and distortion. From a drive along
    mostly straight roads, for a lens given by --camera or --field-of-view, come the camera's pitch and yaw.
    """
    with _writing(out):
        # A drive takes minutes to look through.
        out.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=out.parent):
            pass
    if camera_file is None and field_of_view is None:
        camera = _lens(source, board, height)
    else:
        camera = _mount(source, _start(camera_file, height, field_of_view))
    text = json.dumps(camera.model_dump(mode="json", exclude_defaults=True), indent=2) + "\n"
    with _writing(out):
        out.write_text(text, encoding="utf-8")
    click.echo(f"camera file: {out}")


@contextmanager
def _writing(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise SourceError(f"can't write {out}: {(error.strerror or str(error)).lower()}") from None


def _lens(source: Path, board: tuple[int, int], height: float | None) -> CameraModel:
    if height is None:
        raise click.UsageError("the height of the camera above the road is missing: give --height")
    from lanestream_exporter.camera_calibration import calibrate_lens, views

    lens = calibrate_lens(views(source), board)
    for name, reason in lens.failed:
        click.echo(f"{name} was not used: {reason}")
    click.echo(f"{len(lens.used)} of {len(lens.used) + len(lens.failed)} pictures used")
    click.echo(f"reprojection error {lens.rms:.3f} pixels rms")
    return lens.camera(height)


def _start(camera_file: Path | None, height: float | None, field_of_view: float | None) -> CameraModel:
    """Returns the camera whose direction is to be estimated."""
    if camera_file is None:
        camera = parse_camera(height, field_of_view)
        assert camera is not None  # noqa: S101 - the field of view is given
        return camera
    if field_of_view is not None:
        raise click.UsageError("--field-of-view can't be used with --camera: the file has the lens")
    camera = read_camera_file(camera_file)
    return camera if height is None else camera.model_copy(update={"height": height})


def _mount(source: Path, camera: CameraModel) -> CameraModel:
    from lanestream.engine import load_engine
    from lanestream_exporter.camera_calibration import calibrate_mount, read_pictures

    mount = calibrate_mount(read_pictures(source), camera, load_engine(provider="cpu"))
    click.echo(f"{mount.used} of {mount.frames} frames show a straight road")
    click.echo(f"pitch {mount.pitch:.2f} ± {mount.pitch_sigma:.2f} degrees down")
    click.echo(f"yaw {mount.yaw:.2f} ± {mount.yaw_sigma:.2f} degrees to the left")
    return camera.model_copy(update={"pitch": round(mount.pitch, 2), "yaw": round(mount.yaw, 2)})
