"""`make train-toy`: from labeled frames to an evaluated and served model in less than a minute, all under out/toy/.

The frames are rendered and written like a user's own: one folder of images per drive, with LabelMe labels and a
manifest. The rest follows docs/training.md: data check, train, export, evaluate; then a service detects lanes with it.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import cv2
import httpx
import numpy as np
from demo import LANESTREAM, service

from lanestream_exporter.scenes import render_still, sample_scene

MANIFEST = """[[dataset]]
name = "toy roads"
path = "learn"
split = { by = "group", val = 0.2 }
"""
DRIVES = {"learn": ("monday", "tuesday", "wednesday"), "test": ("thursday", "friday")}
FRAMES = 8


def main(folder: Path) -> None:
    """Runs the whole chain in `folder`. Raises CalledProcessError if a command fails."""
    started = time.monotonic()
    shutil.rmtree(folder, ignore_errors=True)
    for part, drives in DRIVES.items():
        for drive in drives:
            draw_drive(folder / part / drive, seed=sum(drive.encode()))
    config, run, model = folder / "toy.toml", folder / "run", folder / "toy.onnx"
    manifest = folder / "datasets.toml"
    manifest.write_text(MANIFEST, encoding="utf-8")
    config.write_text(toy_recipe().replace("[data]\n", f'[data]\nmanifest = "{manifest}"\n'), encoding="utf-8")
    lanestream("data", "check", folder / "learn", "--against", folder / "test", "--sheet", folder / "sheet.jpg")
    lanestream("train", "classifier", config, "--run", run)
    lanestream(
        "export",
        run / "best.pt",
        model,
        "--regressor",
        "none",
        "--precision",
        "fp32",
        "--scenes",
        "4",
        "--tolerance",
        "5",
    )
    report = folder / "evaluation.json"
    evaluated = "--model", model, "--regressor", "none", "--data", folder / "test"
    lanestream("evaluate", *evaluated, "--labels-only", "--json", report)
    answer = detect_lanes(model, folder / "test" / "thursday" / "0000.jpg", folder / "service.log")
    (folder / "answer.json").write_text(json.dumps(answer, indent=2) + "\n", encoding="utf-8")
    print(f"the service found {len(answer['lanes'])} boundaries; {time.monotonic() - started:.0f} s in all")


def draw_drive(folder: Path, seed: int, frames: int = FRAMES) -> None:
    """Renders images into `folder`, each with a LabelMe file."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for number in range(frames):
        still = render_still(sample_scene(rng, 640, 360))
        name = f"{number:04d}.jpg"
        cv2.imwrite(str(folder / name), still.image)
        lanes = [
            {"label": "lane", "shape_type": "linestrip", "points": lane.points.tolist()} for lane in still.labels.lanes
        ]
        record = {"imagePath": name, "imageWidth": 640, "imageHeight": 360, "shapes": lanes}
        (folder / name).with_suffix(".json").write_text(json.dumps(record), encoding="utf-8")


def toy_recipe() -> str:
    """Returns the shipped recipe of the toy."""
    command = [LANESTREAM, "train", "recipe", "classifier-toy"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def lanestream(*arguments: str | Path) -> None:
    """Runs a Lanestream command with its output on the terminal."""
    print("lanestream", *arguments, flush=True)
    # Without the data folder of this machine, so that paths count from the manifest's folder.
    environment = {name: value for name, value in os.environ.items() if name != "LANESTREAM_DATA"}
    subprocess.run([LANESTREAM, *arguments], check=True, env=environment)


def detect_lanes(model: Path, image: Path, log_path: Path) -> dict[str, object]:
    """Returns the response of a service with `model` to an image."""
    with service(log_path, "--model", model, "--regressor", "none") as url:
        response = httpx.post(f"{url}/v1/detect", content=image.read_bytes(), timeout=30.0).raise_for_status()
    result: dict[str, object] = response.json()
    return result


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/toy"))
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)
    except KeyboardInterrupt:
        sys.exit(130)
