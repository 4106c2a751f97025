"""`make demo-clip`: renders the clip that the live page plays as its demo, a drive on a highway with a lane change.

The clip is VP9 in WebM: browsers of all systems play it, and it is free of patent fees.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.stream import VideoStream

from lanestream_exporter.scenes import Drive, render_clip, sample_clip
from lanestream_exporter.scenes.clip import Clip, without_collisions

SEED, WIDTH, HEIGHT, FPS, SECONDS = 8, 960, 540, 30, 16
# The page knows the camera of its demo: service/lanestream/api/static/settings.js has the same two values.
CAMERA_HEIGHT, FIELD_OF_VIEW = 1.4, 60.0
MOST_BYTES = 2_000_000
# About 0.9 Mbit/s, slowly and well.
OPTIONS = {"b": "900k", "deadline": "good", "cpu-used": "1", "row-mt": "1", "auto-alt-ref": "1", "lag-in-frames": "25"}


def main(out: Path) -> None:
    """Writes the clip to `out`."""
    clip = demo_clip()
    with av.open(str(out), "w", format="webm") as container:
        stream = container.add_stream("libvpx-vp9", rate=FPS, options=OPTIONS)
        assert isinstance(stream, VideoStream)  # noqa: S101
        stream.width, stream.height, stream.pix_fmt, stream.gop_size = WIDTH, HEIGHT, "yuv420p", 4 * FPS
        for number, frame in enumerate(render_clip(clip)):
            video_frame = av.VideoFrame.from_ndarray(frame.image, format="bgr24")
            video_frame.pts, video_frame.time_base = number, Fraction(1, FPS)
            container.mux(stream.encode(video_frame))
        container.mux(stream.encode(None))
    if out.stat().st_size > MOST_BYTES:
        sys.exit(f"error: {out} has {out.stat().st_size} bytes, more than {MOST_BYTES}; lower the bit rate")
    print(f"{out}: {clip.frames} frames of {WIDTH} x {HEIGHT}, {FPS} per second, {out.stat().st_size} bytes")


def demo_clip(seed: int = SEED) -> Clip:
    """Returns the drive, before a camera with a round height and field of view."""
    drive = Drive("highway", lane_change=True, fair=True)
    rng = np.random.default_rng(seed)
    clip = sample_clip(rng, WIDTH, HEIGHT, frames=FPS * SECONDS, fps=float(FPS), drive=drive)
    camera = replace(
        clip.scene.camera, mount_height=CAMERA_HEIGHT, field_of_view=FIELD_OF_VIEW, horizon=0.45 * (HEIGHT - 1)
    )
    clip = replace(clip, scene=replace(clip.scene, camera=camera))
    return replace(clip, scene=replace(clip.scene, traffic=without_collisions(clip)))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
