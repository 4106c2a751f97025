"""Our own detector for single images in LitServe: what a general serving framework achieves with it."""

# Without `from __future__ import annotations`: LitServe reads the annotation of `request` and needs the class itself.

import argparse
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import litserve

from lanestream.engine import load_engine
from lanestream.images.decoding import ImageLimits
from lanestream.messages import ProcessedFrame, lanes_message
from lanestream.workers.frame_worker import EncodedFrame, FrameWorker

# LitServe's documentation uses batches of 8 that wait 50 to 100 ms. A shorter wait is better with few clients.
MAX_BATCH_SIZE: Final = 8
BATCH_TIMEOUT_S: Final = 0.01


class LitServeLaneApi(litserve.LitAPI):  # type: ignore[misc]
    """Images in, lanes out. There are no cameras: every image is processed on its own."""

    def __init__(self, provider: str) -> None:
        super().__init__(max_batch_size=MAX_BATCH_SIZE, batch_timeout=BATCH_TIMEOUT_S)
        self._provider = provider

    def setup(self, device: str) -> None:  # noqa: ARG002 - LitServe's signature
        """Loads and warms up the networks, in the worker process."""
        self._engine = load_engine(provider=self._provider)
        self._worker = FrameWorker(self._engine.models, ImageLimits())
        self._threads = ThreadPoolExecutor(MAX_BATCH_SIZE)

    def decode_request(self, request: litserve.Request) -> bytes:
        """Reads the image file in the form field `image`."""
        data: bytes = request["image"].file.read()
        return data

    def predict(self, images: Sequence[bytes]) -> list[ProcessedFrame]:
        """Finds the lanes in a batch of images. What they need from the networks is run together."""
        return list(self._threads.map(self._find_lanes, images))

    def encode_response(self, output: ProcessedFrame) -> dict[str, Any]:
        """Returns the message that our service sends, too."""
        return lanes_message(output, seq=0, timestamp=time.monotonic()).model_dump(mode="json")

    def _find_lanes(self, image: bytes) -> ProcessedFrame:
        return self._worker.process(self._engine.open_session(), EncodedFrame(image, 0.0, time.monotonic()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--provider", required=True)
    options = parser.parse_args()
    server = litserve.LitServer(LitServeLaneApi(options.provider), accelerator="cpu", devices=1, timeout=120)
    server.run(host="127.0.0.1", port=options.port, log_level="warning", generate_client_file=False)
