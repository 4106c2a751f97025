"""Answers frames with the code of a checkout: run as a script in its own process, with the checkout's packages.

python -P worker.py [MODEL]

A request is a line of JSON and, after it, the pixels of the frame, BGR uint8. With `camera` it is the first frame of a
new camera with those parameters, which may be null. With `single_image` it is a frame of its own, and the other camera
stays as it is. A reply is a line of JSON with the `lanes` message. Only the standard library, NumPy and an API that
versions since 0.9.0 have are used.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from functools import partial
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from lanestream.local import LocalCamera, LocalEngine


def open_camera(engine: LocalEngine, camera: Mapping[str, Any] | None, single_image: bool = False) -> LocalCamera:
    """Returns a new camera with the parameters of `camera`, or those of them that the version knows.

    It is for a `single_image`, if the version makes a difference.
    """
    from pydantic import ValidationError

    from lanestream.protocol import CameraModel

    is_known = "single_image" in signature(engine.open_camera).parameters
    opened = partial(engine.open_camera, single_image=True) if single_image and is_known else engine.open_camera
    if camera is None:
        return opened()
    try:
        model = CameraModel.model_validate(camera)
    except ValidationError:
        # Older versions know the height and the field of view only.
        model = CameraModel.model_validate({key: camera[key] for key in ("height", "field_of_view")})
    return opened(camera=model)


def main(model: Path | None) -> None:
    """Answers requests until stdin ends."""
    import lanestream.local

    requests, replies = sys.stdin.buffer, os.fdopen(os.dup(1), "w", encoding="utf-8")
    # Whatever a library prints must not get between the replies.
    os.dup2(2, 1)
    engine = lanestream.local.LocalEngine.load(model, "cpu")
    replies.write(json.dumps({"package": lanestream.__file__, "version": lanestream.__version__}) + "\n")
    replies.flush()
    cameras: dict[bool, LocalCamera] = {}
    for line in requests:
        request = json.loads(line)
        (height, width), single_image = request["size"], request["single_image"]
        pixels = requests.read(height * width * 3)
        if "camera" in request:
            cameras[single_image] = open_camera(engine, request["camera"], single_image)
        image = np.frombuffer(pixels, np.uint8).reshape(height, width, 3)
        message = cameras[single_image].lanes(image, seq=request["seq"], timestamp=request["timestamp"])
        replies.write(message.model_dump_json(exclude={"timing_ms"}) + "\n")
        replies.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
