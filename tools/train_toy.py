"""`make train-toy`: from labelled frames to an evaluated model that serves, in less than a minute; all under out/toy/.

The frames are rendered and written as somebody's own would be: folders of pictures, one a drive, with LabelMe labels.
The rest is what docs/training.md says: data check, train, export, evaluate; then a service answers with the model.
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

DRIVES = {"learn": ("monday", "tuesday", "wednesday"), "test": ("thursday", "friday")}
FRAMES = 8


def main(folder: Path) -> None:
    """Runs the whole chain in `folder`; raises CalledProcessError where a command fails."""
    started = time.monotonic()
    shutil.rmtree(folder, ignore_errors=True)
    for part, drives in DRIVES.items():
        for drive in drives:
            draw_drive(folder / part / drive, seed=sum(drive.encode()))
    config, run, model = folder / "toy.toml", folder / "run", folder / "toy.onnx"
    config.write_text(recipe() + f'\n[[data.train]]\npath = "{folder / "learn"}"\n', encoding="utf-8")
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
    lanestream("evaluate", "--model", model, "--regressor", "none", "--data", folder / "test", "--json", report)
    answer = served(model, folder / "test" / "thursday" / "0000.jpg", folder / "service.log")
    (folder / "answer.json").write_text(json.dumps(answer, indent=2) + "\n", encoding="utf-8")
    print(f"the service found {len(answer['lanes'])} boundaries; {time.monotonic() - started:.0f} s in all")


def draw_drive(folder: Path, seed: int) -> None:
    """Renders pictures into `folder`, each with a LabelMe file beside it."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for number in range(FRAMES):
        still = render_still(sample_scene(rng, 640, 360))
        name = f"{number:04d}.jpg"
        cv2.imwrite(str(folder / name), still.image)
        lanes = [
            {"label": "lane", "shape_type": "linestrip", "points": lane.points.tolist()} for lane in still.labels.lanes
        ]
        record = {"imagePath": name, "imageWidth": 640, "imageHeight": 360, "shapes": lanes}
        (folder / name).with_suffix(".json").write_text(json.dumps(record), encoding="utf-8")


def recipe() -> str:
    """The shipped configuration of the toy."""
    command = [LANESTREAM, "train", "recipe", "classifier-toy"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def lanestream(*arguments: str | Path) -> None:
    """Runs a command of the product, its output on the terminal."""
    print("lanestream", *arguments, flush=True)
    # The project's own frames, where a machine has them, are left out: the toy is the same everywhere.
    environment = {name: value for name, value in os.environ.items() if name != "LANESTREAM_DATA"}
    subprocess.run([LANESTREAM, *arguments], check=True, env=environment)


def served(model: Path, picture: Path, log_path: Path) -> dict[str, object]:
    """What a service of its own answers about a picture."""
    with service(log_path, "--model", model, "--regressor", "none") as url:
        answer = httpx.post(f"{url}/v1/detect", content=picture.read_bytes(), timeout=30.0).raise_for_status()
    found: dict[str, object] = answer.json()
    return found


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/toy"))
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)
    except KeyboardInterrupt:
        sys.exit(130)
