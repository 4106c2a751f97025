"""A straightforward lane service as a baseline, in the style of the first published Hough, AlexNet and Kalman tracker.

It receives a frame, finds its lanes, sends them and receives the next frame, all in the event loop. The candidates are
the strongest lines of the extended Hough transform. For each one the frame is masked except for 15 pixels on each side
of the line, cropped and scaled to 224 x 224. A full-size AlexNet in eager PyTorch classifies them in one batch, and a
Kalman filter tracks the best one on each side. The weights are random: the run time does not depend on them.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
import uvicorn
from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from lanestream.detection.features import find_edges
from lanestream.detection.hough import hough_lines
from lanestream.road.view import WORKING_WIDTH, Image
from lanestream_exporter.alexnet import FULL, AlexNet

HORIZON = 0.45  # of the image height; fixed, as for one camera
HALF_WIDTH = 15  # pixels on each side of a line, in a frame 640 wide

# The columns at the bottom row and at the horizon.
Line = tuple[float, float]


@dataclass
class BaselineTracker:
    """A constant-velocity Kalman filter for the boundary on each side."""

    filters: dict[str, KalmanFilter] = field(default_factory=dict)

    def update(self, side: str, line: Line | None) -> Line | None:
        """Returns the boundary's filtered position; without a measured `line` it is predicted."""
        if side not in self.filters:
            if line is None:
                return None
            self.filters[side] = _filter(line)
        kalman = self.filters[side]
        kalman.predict()
        if line is not None:
            kalman.update(np.array(line))
        return float(kalman.x[0]), float(kalman.x[1])


def _filter(line: Line) -> KalmanFilter:
    kalman = KalmanFilter(dim_x=4, dim_z=2)
    kalman.x = np.array([*line, 0.0, 0.0])
    kalman.F = np.eye(4) + np.eye(4, k=2)
    kalman.H = np.eye(2, 4)
    kalman.P *= 100.0
    return kalman


def candidate_lines(image: Image, limit: int) -> list[Line]:
    """Returns the strongest Hough lines, at most `limit`, in pixels of the image."""
    scale = WORKING_WIDTH / image.shape[1]
    gray = np.asarray(cv2.cvtColor(cv2.resize(image, None, fx=scale, fy=scale), cv2.COLOR_BGR2GRAY), np.uint8)
    top, bottom = int(HORIZON * gray.shape[0]), gray.shape[0] - 1
    lines = hough_lines(find_edges(gray, top), gray.shape[1], bottom)
    tops = lines.x_bottom + lines.slope * (top - bottom)
    return [(float(x) / scale, float(t) / scale) for x, t in zip(lines.x_bottom, tops, strict=True)][:limit]


def masked_patch(image: Image, line: Line) -> Image:
    """Returns the frame with everything masked except the strip along the line, cropped to the strip and scaled."""
    height, width = image.shape[:2]
    offset, top = HALF_WIDTH * width / WORKING_WIDTH, HORIZON * height
    near, far = line
    strip = [(near - offset, height), (near + offset, height), (far + offset, top), (far - offset, top)]
    corners = np.clip(np.array(strip), (-4.0 * width, 0.0), (5.0 * width, height)).astype(np.int32)
    mask = np.zeros(image.shape, np.uint8)
    cv2.fillPoly(mask, [corners], (1, 1, 1))
    masked = image * mask
    left, right = np.clip((corners[:, 0].min(), corners[:, 0].max()), 0, width)
    crop = masked[int(top) :, left : max(right, left + 1)] if left < width else masked[int(top) :]
    return np.asarray(cv2.resize(crop, (FULL.size, FULL.size)), np.uint8)


@torch.inference_mode()
def lane_probabilities(network: AlexNet, patches: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Returns the probability that each patch shows a boundary; patches are (N, 224, 224, 3)."""
    inputs = torch.from_numpy(patches).permute(0, 3, 1, 2).float() / 255.0
    probabilities: NDArray[np.float32] = torch.softmax(network(inputs), dim=1)[:, 1].numpy()
    return probabilities


def find_lanes(network: AlexNet, tracker: BaselineTracker, data: bytes, limit: int) -> dict[str, Line | None]:
    """Returns the two boundaries of the ego lane in an image file."""
    image = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), np.uint8)
    lines = candidate_lines(image, limit)
    best: dict[str, Line] = {}
    if lines:
        patches = np.stack([masked_patch(image, line) for line in lines])
        for index in np.argsort(lane_probabilities(network, patches)):
            best["left" if lines[index][0] < image.shape[1] / 2 else "right"] = lines[index]
    return {side: tracker.update(side, best.get(side)) for side in ("left", "right")}


def create_app(limit: int) -> FastAPI:
    """Returns the service, which classifies at most `limit` candidates per frame."""
    app = FastAPI()
    torch.manual_seed(0)
    network = AlexNet(batch_norm=False).eval()
    lane_probabilities(network, np.zeros((limit, FULL.size, FULL.size, 3), np.uint8))

    @app.get("/readyz")
    async def ready() -> dict[str, str]:
        return {"status": "ready"}

    @app.websocket("/stream")
    async def stream(socket: WebSocket) -> None:
        await socket.accept()
        tracker = BaselineTracker()
        try:
            while True:
                lanes = find_lanes(network, tracker, await socket.receive_bytes(), limit)
                await socket.send_text(json.dumps({"type": "lanes", **lanes}))
        except WebSocketDisconnect:
            pass

    return app


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--candidates", type=int, required=True)
    options = parser.parse_args()
    uvicorn.run(create_app(options.candidates), port=options.port, log_level="warning")
