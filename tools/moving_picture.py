"""Draws the moving picture for the documentation: four seconds of a rendered drive with its lanes, as animated WebP.

It fails if a line in any frame is not a lane boundary of the scene.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
from picture import FPS, FRAMES, tracked_frames
from PIL import Image

from lanestream.protocol import LaneModel, LanesMessage
from lanestream.road.curve import Curve
from lanestream_client.overlays import draw_lanes
from lanestream_exporter.datasets.labels import LabeledFrame
from lanestream_exporter.evaluation.boundaries import ReportedBoundary, match

FIRST = 12  # the tracker starts before the picture does
SIZE = (720, 405)  # width and height
MOST_BYTES = 1_500_000
QUALITIES = (80, 72, 64, 56, 48)


def main(out: Path) -> None:
    """Writes the picture to `out`. Raises RuntimeError if it would show a wrong line or be too large."""
    shown = []
    for frame, lanes in tracked_frames(FRAMES):
        if lanes.seq >= FIRST:
            check(lanes, frame.labels)
            drawn = cv2.resize(draw_lanes(frame.image, lanes), SIZE, interpolation=cv2.INTER_AREA)
            shown.append(Image.fromarray(drawn[..., ::-1]))
    out.parent.mkdir(parents=True, exist_ok=True)
    write(shown, out)
    print(f"wrote {out}: {len(shown)} frames, {out.stat().st_size / 1e6:.2f} MB")


def check(message: LanesMessage, labels: LabeledFrame) -> None:
    """Raises RuntimeError if a reported boundary is not one of the scene's."""
    wrong = match([reported(lane) for lane in message.lanes], labels.lanes, labels).wrong_reports
    if wrong:
        tracks = ", ".join(str(message.lanes[index].track_id) for index in wrong)
        raise RuntimeError(f"frame {message.seq} has wrong lines (track ids {tracks}): choose another seed")


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
