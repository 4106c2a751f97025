"""Draws the moving picture for the documentation: four seconds of a rendered drive with its lanes, as animated WebP.

It fails if a line in any frame is not a lane boundary of the scene, or if a boundary of the ego lane is missing.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from lanestream.local import LocalEngine
from lanestream.protocol import CameraModel, LaneModel, LanesMessage
from lanestream.road.curve import Curve
from lanestream_client.overlays import draw_lanes
from lanestream_exporter.datasets.labels import LabeledFrame
from lanestream_exporter.evaluation.boundaries import ReportedBoundary, match, match_ego
from lanestream_exporter.scenes import Drive, render_clip, sample_clip

SEED, WIDTH, HEIGHT, FPS = 24, 1280, 720, 12.5
# The tracker starts before the picture does.
FIRST, FRAMES = 12, 62
SHOWN = (720, 405)  # width and height of the picture
MOST_BYTES = 1_500_000
QUALITIES = (80, 72, 64, 56, 48)


def main(out: Path, seed: int = SEED) -> None:
    """Writes the picture to `out`. Raises RuntimeError if it would show a wrong line or be too large."""
    drive = Drive("highway", lane_change=True, fair=True)
    clip = sample_clip(np.random.default_rng(seed), WIDTH, HEIGHT, frames=FRAMES, fps=FPS, drive=drive)
    lens = clip.scene.camera
    model = CameraModel(height=lens.mount_height, field_of_view=lens.field_of_view)
    camera = LocalEngine.load(None, "cpu").open_camera(camera=model)
    shown = []
    for seq, frame in enumerate(render_clip(clip)):
        lanes = camera.lanes(frame.image, seq=seq, timestamp=frame.timestamp)
        if seq >= FIRST:
            check(lanes, frame.labels)
            drawn = cv2.resize(draw_lanes(frame.image, lanes), SHOWN, interpolation=cv2.INTER_AREA)
            shown.append(Image.fromarray(drawn[..., ::-1]))
    out.parent.mkdir(parents=True, exist_ok=True)
    write(shown, out)
    print(f"wrote {out}: {len(shown)} frames, {out.stat().st_size / 1e6:.2f} MB")


def check(message: LanesMessage, labels: LabeledFrame) -> None:
    """Raises RuntimeError if a reported boundary is none of the scene's, or if one of the ego lane is missing."""
    reports = [reported(lane) for lane in message.lanes]
    wrong = match(reports, labels.lanes, labels).wrong_reports
    if wrong:
        tracks = ", ".join(str(message.lanes[index].track_id) for index in wrong)
        raise RuntimeError(f"frame {message.seq} has wrong lines (tracks {tracks}): choose another seed")
    ego = match_ego(reports, labels)
    if ego.missed or ego.wrong:
        raise RuntimeError(f"frame {message.seq} lacks a boundary of the ego lane: choose another seed")


def reported(lane: LaneModel) -> ReportedBoundary:
    """Returns a lane of a message as the evaluation takes it."""
    curve = Curve(lane.horizon, lane.coefficients)
    return ReportedBoundary(curve, lane.line.top[1], lane.line.bottom[1], lane.position, lane.track_id, kind=lane.kind)


def write(frames: list[Image.Image], out: Path) -> None:
    """Writes an animation that repeats forever, in the best quality that the limit of its size allows."""
    for quality in QUALITIES:
        options = {"duration": round(1e3 / FPS), "loop": 0, "quality": quality, "method": 4}
        frames[0].save(out, format="WEBP", save_all=True, append_images=frames[1:], **options)
        if out.stat().st_size <= MOST_BYTES:
            return
    out.unlink()
    raise RuntimeError(f"the picture has more than {MOST_BYTES} bytes even in quality {QUALITIES[-1]}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
