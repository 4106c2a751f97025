"""Writing a rendered clip: an MP4 file and its labels, one JSON object a line."""

from __future__ import annotations

import json
from collections.abc import Callable
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import av
from av.video.stream import VideoStream

from lanestream_exporter.scenes.clip import Clip, render_clip

if TYPE_CHECKING:
    from pathlib import Path

    from lanestream_exporter.datasets.labels import LabelledFrame

ENCODERS = ("libx264", "libopenh264", "mpeg4")  # the best first; builds of FFmpeg differ in what they hold
Progress = Callable[[int, int], None]  # frames done, frames in all


def write_clip(clip: Clip, video: Path, labels: Path, progress: Progress | None = None) -> None:
    """Renders `clip` into an MP4 file at `video` and writes the labels of every frame to `labels`.

    Raises ValueError where the picture's width or height is odd: 4:2:0 video halves both for colour.
    """
    camera = clip.scene.camera
    if camera.width % 2 or camera.height % 2:
        raise ValueError(f"a video needs an even width and height, got {camera.width}x{camera.height}")
    with av.open(str(video), "w", format="mp4") as container, labels.open("w", encoding="utf-8") as lines:
        stream = _add_stream(container, clip)
        for number, frame in enumerate(render_clip(clip)):
            picture = av.VideoFrame.from_ndarray(frame.image, format="bgr24")
            picture.pts = number
            picture.time_base = Fraction(1) / _rate(clip.fps)
            container.mux(stream.encode(picture))
            lines.write(json.dumps(label_record(frame.labels, video.name, number)) + "\n")
            if progress:
                progress(number + 1, clip.frames)
        container.mux(stream.encode(None))


def label_record(labels: LabelledFrame, clip: str, frame: int) -> dict[str, Any]:
    """The labels of one frame as they stand in a clip's label file."""
    return {
        "clip": clip,
        "frame": frame,
        "width": labels.width,
        "height": labels.height,
        "lanes": [
            {
                "id": lane.lane_id,
                "position": lane.position,
                "type": lane.kind,
                "color": lane.color,
                "points": lane.points.round(1).tolist(),
            }
            for lane in labels.lanes
        ],
    }


def _add_stream(container: av.container.OutputContainer, clip: Clip) -> VideoStream:
    encoder = next(name for name in ENCODERS if name in av.codecs_available)
    stream = container.add_stream(encoder, rate=_rate(clip.fps))
    if not isinstance(stream, VideoStream):
        raise TypeError(f"{encoder} made a {type(stream).__name__}, not a video stream")
    stream.width, stream.height = clip.scene.camera.width, clip.scene.camera.height
    stream.pix_fmt = "yuv420p"
    if encoder == "libx264":
        stream.options = {"crf": "18", "preset": "veryfast"}
    else:
        stream.bit_rate = round(0.2 * stream.width * stream.height * clip.fps)
    return stream


def _rate(fps: float) -> Fraction:
    """The frame rate as a fraction that every container can hold."""
    return Fraction(fps).limit_denominator(1001)
