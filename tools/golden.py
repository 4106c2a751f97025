"""The answers of both detectors to rendered frames and a rendered drive: what a change that only renames must keep."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import numpy as np

from lanestream.local import LocalEngine
from lanestream.protocol import CameraModel, LanesMessage
from lanestream_exporter.scenes import render_still, sample_scene
from lanestream_exporter.scenes.clip import Drive, render_clip, sample_clip

_SIZES = ((640, 360), (1280, 720), (640, 480))
_SEED = 2718


def golden_answers() -> dict[str, list[dict[str, Any]]]:
    """Answers by detector and material, without their timing."""
    engine = LocalEngine.load(None, "cpu")
    stills = [
        render_still(sample_scene(np.random.default_rng([_SEED, n]), *_SIZES[n % len(_SIZES)])).image for n in range(12)
    ]
    clip = sample_clip(np.random.default_rng(_SEED), 640, 360, 30, 20.0, Drive("highway", lane_change=True))
    drive = [frame.image for frame in render_clip(clip)]
    answers: dict[str, list[dict[str, Any]]] = {}
    for detector in ("candidates", "regression"):
        cameras = [engine.open_camera(detector=detector, single_image=True) for _ in stills]
        single = [camera.lanes(image, seq=0, timestamp=0.0) for camera, image in zip(cameras, stills, strict=True)]
        camera = engine.open_camera(detector=detector, camera=CameraModel(height=1.4, field_of_view=60.0))
        stream = [camera.lanes(image, seq=n, timestamp=n / 20.0) for n, image in enumerate(drive)]
        answers[f"{detector}: stills"] = [_without_timing(message) for message in single]
        answers[f"{detector}: drive"] = [_without_timing(message) for message in stream]
    return answers


def _without_timing(message: LanesMessage) -> dict[str, Any]:
    answer = message.model_dump(mode="json", exclude={"timing_ms": True, "lanes": {"__all__": {"covariance", "line"}}})
    for lane in answer["lanes"]:
        lane["points"] = lane["points"][::6]
        # They are sensitive to the last digit; the points say the same in pixels.
        del lane["coefficients"], lane["ground"], lane["ground_covariance"]
    return answer


@click.command()
@click.argument("path", type=click.Path(path_type=Path))
def main(path: Path) -> None:
    """Write the answers to PATH, for a change that is meant to change them."""
    text = json.dumps(golden_answers(), separators=(",", ":")).replace('{"type"', '\n{"type"')
    path.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
