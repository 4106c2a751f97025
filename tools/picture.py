"""Draws the image for the README: the lanes of a rendered road, after two seconds of tracking."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from lanestream.local import LocalEngine
from lanestream.protocol import CameraModel
from lanestream_client.overlays import draw_lanes
from lanestream_exporter.scenes import Drive, render_clip, sample_clip

SEED, WIDTH, HEIGHT, FRAMES, FPS = 24, 1280, 720, 50, 25.0


def main(out: Path) -> None:
    """Writes the image to `out`."""
    drive = Drive("highway", lane_change=True, fair=True)
    clip = sample_clip(np.random.default_rng(SEED), WIDTH, HEIGHT, frames=FRAMES, fps=FPS, drive=drive)
    lens = clip.scene.camera
    model = CameraModel(height=lens.mount_height, field_of_view=lens.field_of_view)
    camera = LocalEngine.load(None, "cpu").open_camera(camera=model)
    for seq, frame in enumerate(render_clip(clip)):
        lanes = camera.lanes(frame.image, seq=seq, timestamp=frame.timestamp)
    out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out), draw_lanes(frame.image, lanes), [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
