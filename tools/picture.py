"""Draws the picture for the README: the lanes of a rendered road, after some seconds of tracking."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from lanestream.local import LocalEngine
from lanestream.protocol import CameraModel, LanesMessage, TimingModel
from lanestream_client.overlays import draw_lanes
from lanestream_exporter.scenes import Drive, RenderedFrame, render_clip, sample_clip

SEED, WIDTH, HEIGHT, FRAMES, FPS = 4, 1280, 720, 62, 12.5
SHOWN = 40  # the frame in the picture
# Times would differ from run to run, and with them the picture.
NO_TIMES = TimingModel(decode=0, propose=0, queue=0, infer=0, track=0, total=0)


def main(out: Path) -> None:
    """Writes the image to `out`."""
    *_, (frame, lanes) = tracked_frames(SHOWN + 1)
    out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out), draw_lanes(frame.image, lanes), [cv2.IMWRITE_JPEG_QUALITY, 88])


def tracked_frames(count: int) -> Iterator[tuple[RenderedFrame, LanesMessage]]:
    """Yields the first `count` frames of a drive that changes its lane, with their lanes."""
    drive = Drive("highway", lane_change=True, fair=True)
    clip = sample_clip(np.random.default_rng(SEED), WIDTH, HEIGHT, frames=FRAMES, fps=FPS, drive=drive)
    lens = clip.scene.camera
    model = CameraModel(height=lens.mount_height, field_of_view=lens.field_of_view)
    camera = LocalEngine.load(None, "cpu").open_camera(camera=model)
    for seq, frame in zip(range(count), render_clip(clip), strict=False):
        lanes = camera.lanes(frame.image, seq=seq, timestamp=frame.timestamp)
        yield frame, lanes.model_copy(update={"timing_ms": NO_TIMES})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
